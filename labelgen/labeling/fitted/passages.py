"""Passages: which masks of a video show the same vehicle, joined on the road plane.

The links of a block of time are decided by the sightings within a margin around it (`PassageSettings.block_s`,
`margin_s`), and by nothing else: parts of a video that overlap enough give the same links.
"""

from __future__ import annotations

from math import floor

import numpy as np

from labelgen.errors import DataError
from labelgen.geometry.homography import Array, IntArray
from labelgen.labeling.fitted.passage_links import link_sightings
from labelgen.labeling.fitted.sightings import PASSAGE_SETTINGS, PassageSettings, Sightings

__all__ = ["PASSAGE_SETTINGS", "PassageJoiner", "PassageSettings", "Sightings", "join_passages"]

_NONE = -1


def join_passages(sightings: Sightings, settings: PassageSettings = PASSAGE_SETTINGS) -> IntArray:
    """Join the masks of each vehicle.

    The links between sightings of a time are the same whatever else is given, if all sightings of
    `settings.block_s + settings.margin_s` before and after that time are.

    Args:
        sightings: N masks of one video, or of a part of it, in the order of time.
        settings: thresholds.

    Returns:
        (N,) number of the passage of each mask, from 0 in the order of the first sightings. A mask that belongs to no
        other has a passage of its own.
    """
    joiner = PassageJoiner(settings)
    numbers = np.full(len(sightings), _NONE)
    _, starts = np.unique(np.floor(sightings.times_s / settings.block_s), return_index=True)
    parts = [sightings.take(slice(*ends)) for ends in zip(starts, [*starts[1:], len(sightings)], strict=True)]
    passages = [members for part in parts for members in joiner.add(part)] + joiner.finish()
    for number, members in enumerate(sorted(passages, key=lambda members: int(members[0]))):
        numbers[members] = number
    return numbers


class PassageJoiner:
    """Join masks of a video that come one after another; `join_passages` in parts, with the same result.

    It holds the sightings of two margins and a block, and the numbers of those whose passage goes on.

    Args:
        settings: thresholds.
    """

    def __init__(self, settings: PassageSettings = PASSAGE_SETTINGS) -> None:
        self.settings = settings
        self._parts: list[Sightings] = []
        self._offset = 0
        self._last_s = -np.inf
        self._block = 0
        self._sources: dict[int, list[int]] = {}
        self._open: dict[int, tuple[float, list[int], list[Array]]] = {}

    def add(self, sightings: Sightings) -> list[IntArray]:
        """Add the masks of one or more whole frames.

        Args:
            sightings: masks later than all that were added before; N may be 0.

        Returns:
            The passages that have ended: of each the numbers of its masks, ascending, counted in the order in which
            they were added, from 0. Each mask is handed out once.

        Raises:
            DataError: a mask is not later than one that was added before.
        """
        if not len(sightings):
            return []
        if sightings.times_s[0] <= self._last_s:
            raise DataError(f"passages: the time {sightings.times_s[0]:g} s was added before; add frames in order")
        if not self._parts:
            self._block = floor(float(sightings.times_s[0]) / self.settings.block_s)
        self._parts.append(sightings)
        self._last_s = float(sightings.times_s[-1])
        return self._advance(self._last_s)

    def finish(self) -> list[IntArray]:
        """Return the passages that have not been handed out; no more masks are coming."""
        return self._advance(np.inf)

    def _advance(self, until_s: float) -> list[IntArray]:
        """Decide the blocks whose sightings are complete, and return the passages that have ended."""
        s = self.settings
        ended: list[IntArray] = []
        while self._parts and (self._block + 1) * s.block_s + s.margin_s < until_s:
            pending = Sightings.joined(self._parts)
            start, end = self._block * s.block_s, (self._block + 1) * s.block_s
            low, first, last, high = np.searchsorted(
                pending.times_s, [start - s.margin_s, start, end, end + s.margin_s]
            ).tolist()
            source, target = link_sightings(pending.take(slice(low, high)), s) + low
            inside = (source >= first) & (source < last)
            for i, j in zip(source[inside].tolist(), target[inside].tolist(), strict=True):
                self._sources.setdefault(j + self._offset, []).append(i + self._offset)
            ended += self._extend(pending, first, last)
            if last == len(pending):
                self._offset, self._parts = self._offset + last, []
                break
            self._block = max(self._block + 1, floor(float(pending.times_s[last]) / s.block_s))
            drop = int(np.searchsorted(pending.times_s, self._block * s.block_s - s.margin_s))
            self._offset, self._parts = self._offset + drop, [pending.take(slice(drop, None))]
        return ended

    def _extend(self, pending: Sightings, first: int, last: int) -> list[IntArray]:
        """Add the sightings of a decided block to passages, and return the passages that have ended."""
        for i in range(first, last):
            number, time, point = i + self._offset, float(pending.times_s[i]), pending.points_m[i]
            sources = self._sources.pop(number, [])
            begin, members, points = self._open.get(sources[0] if len(sources) == 1 else _NONE, (time, [], []))
            if members and time - begin <= self.settings.max_length_s:
                self._open[number] = self._open.pop(members[-1])
                members.append(number)
                points.append(point)
            else:
                self._open[number] = time, [number], [point]
        awaited = {i for sources in self._sources.values() for i in sources}
        out: list[IntArray] = []
        for tail in [tail for tail in self._open if tail not in awaited]:
            _, members, points = self._open.pop(tail)
            out += _one_way(np.array(members), np.array(points), self.settings.turn_m)
        return out


def _one_way(members: IntArray, points_m: Array, turn_m: float) -> list[IntArray]:
    """Return the parts of a passage (M,) within which the vehicle does not turn round."""
    for x in (points_m[:, 0], -points_m[:, 0]):
        turn = int(x.argmax())
        if min(np.ptp(x[: turn + 1]), np.ptp(x[turn:])) > turn_m:
            # Two vehicles that met: cut where the step across the road is largest.
            near = np.flatnonzero((x[1:] > x[turn] - turn_m) & (x[:-1] > x[turn] - turn_m))
            cut = int(near[np.abs(np.diff(points_m[:, 1]))[near].argmax()]) + 1 if len(near) else turn
            parts = slice(None, cut), slice(cut, None)
            return [piece for part in parts for piece in _one_way(members[part], points_m[part], turn_m)]
    return [members]
