"""Passages: which masks of a video show the same vehicle, joined on the road plane.

Convention:
    Points are (N, 2) float64 metres on the road, X along VP1, Y to the left; sightings stand in the order of time. A
    link (i, j) says that sighting j is the next one of the vehicle of sighting i.

Links are scored, in units of the logarithm of a likelihood ratio, by size, drift across the road and class; pairs of
successive links by how constant the velocity is; each link by the speeds of the other vehicles of its lane. A link is
taken where it is better than each other link of its two sightings by a margin; what stays ambiguous is not joined.

The links of a block of time are decided by the sightings within a margin around it (`PassageSettings.block_s`,
`margin_s`), and by nothing else: parts of a video that overlap enough give the same links.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import floor

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.geometry.homography import Array, IntArray

__all__ = ["PASSAGE_SETTINGS", "PassageJoiner", "PassageSettings", "Sightings", "join_passages"]

BoolArray = NDArray[np.bool_]
_NONE = -1
_SPEED_RANGE = 120.0
"""Range of the speeds of false links, m/s: from -60 to 60."""


@dataclass(frozen=True)
class Sightings:
    """Masks of one video in the order of time; all arrays of one length N.

    Args:
        times_s: (N,) seconds, not descending; the same for all masks of a frame.
        frames: (N,) numbers of the frames, not descending.
        points_m: (N, 2) where the middle of the mask's lower side meets the road, metres; NaN is joined with nothing.
        widths_m: (N,) width of the lower side on the road, metres, roughly.
        heights_m: (N,) height or another measure of size, roughly.
        class_ids: (N,) 0 where the class is unknown.
        cut: (N,) bool, whether the frame's border cuts the mask.
        m_per_px: (N, 2) length on the road of one pixel of the frame at the point, along and across, metres; zeros where
            left out.
        every_frame: distance of the frames that were searched for masks: 1 if all were.

    Raises:
        DataError: lengths differ, the order is wrong, or `every_frame` is less than 1.
    """

    times_s: Array
    frames: IntArray
    points_m: Array
    widths_m: Array
    heights_m: Array
    class_ids: IntArray
    cut: BoolArray
    m_per_px: Array | None = None
    every_frame: int = 1

    def __post_init__(self) -> None:
        n = len(self.times_s)
        if self.m_per_px is None:
            object.__setattr__(self, "m_per_px", np.zeros((n, 2)))
        problems = [
            f"{name}: expected shape {shape}, got {value.shape}"
            for name, value in self._arrays().items()
            if value.shape != (shape := (n, 2) if name in ("points_m", "m_per_px") else (n,))
        ]
        if not problems:
            problems += [
                f"{name}: expected an ascending order"
                for name, value in (("times_s", self.times_s), ("frames", self.frames))
                if not (np.diff(value) >= 0).all()
            ]
        if self.every_frame < 1:
            problems.append(f"every_frame: expected 1 or more, got {self.every_frame}")
        if problems:
            raise DataError("sightings: " + "; ".join(problems))

    def __len__(self) -> int:
        return len(self.times_s)

    def _arrays(self) -> dict[str, NDArray[np.generic]]:
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "every_frame"}

    def take(self, index: IntArray | BoolArray | slice) -> Sightings:
        """Return some of the sightings."""
        return replace(self, **{name: value[index] for name, value in self._arrays().items()})

    @classmethod
    def joined(cls, parts: Sequence[Sightings]) -> Sightings:
        """Return the sightings of parts of one video that follow each other."""
        arrays = [part._arrays() for part in parts]
        return replace(parts[0], **{name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]})


@dataclass(frozen=True)
class PassageSettings:
    """Thresholds of the joining."""

    block_s: float = 5.0
    """Time whose links are decided at once, seconds. Blocks begin at multiples of it."""
    margin_s: float = 5.0
    """Time before and after a block whose sightings decide its links, seconds."""
    max_missed: int = 2
    """Most frames without a sighting within a link."""
    max_gap_s: float = 1.6
    """Longest time without a sighting, seconds: after more, another vehicle may be there."""
    max_length_s: float = 60.0
    """Longest passage, seconds; a vehicle that stands longer gives several, so that memory stays flat."""
    max_speed_ms: float = 60.0
    """Highest speed along the road, m/s."""
    usual_speed_ms: float = 45.0
    """Up to this speed no speed is less likely than another, m/s."""
    drift_ms: float = 0.5
    """Standard deviation of the speed across the road, m/s: a change of lanes is 1 m/s."""
    heading: float = 0.03
    """Standard deviation of the drift across the road per metre along it: bends and errors of VP1."""
    acceleration_ms2: float = 2.0
    """Standard deviation of the acceleration, m/s^2: braking in traffic; three times as much in an emergency."""
    noise_m: tuple[float, float] = (0.35, 0.2)
    """Standard deviation of a point along and across the road, metres, without what a pixel adds."""
    noise_px: float = 0.7
    """The same of the mask's lower side, px."""
    cut_noise_m: tuple[float, float] = (2.5, 0.7)
    """The same of a mask that the border cuts, metres: up to a vehicle's length is missing."""
    size_ratio: float = 0.2
    """Standard deviation of the logarithm of the ratio of two sizes of one vehicle."""
    class_cost: float = 1.5
    """Cost of two classes that differ: networks call one vehicle a car and a van."""
    missed_cost: float = 2.5
    """Cost of each frame without a sighting within a link: about one sighting in ten is missing."""
    link_gain: float = 6.0
    """Score of a link without costs: a vehicle is seen again far more often than it ends and another begins there."""
    false_length_m: float = 15.0
    """Range along the road over which the prediction of a false link errs, metres."""
    min_prediction: float = -2.0
    """Least score of a pair of successive links: less, and the velocity is not constant."""
    rounds: int = 4
    """Links that a prediction looks ahead and back."""
    margins: tuple[float, ...] = (6.0, 4.5, 3.5)
    """By how much a link must be better than the others of its sightings, in one round after another."""
    min_score: float = 3.5
    """Least score of a link."""
    double_m: tuple[float, float] = (2.5, 1.2)
    """Masks of a frame closer than this along and across the road, metres, show one vehicle: the larger counts."""
    lane_m: float = 0.8
    """Standard deviation of the places across the road at which vehicles drive at the speed of a lane, metres."""
    lane_speed_ms: float = 3.0
    """Standard deviation of the speeds of a lane within a block and its margins, m/s."""
    lane_support: tuple[float, float] = (-3.0, 3.0)
    """Least and largest score that the speeds of a lane add to a link."""
    min_speed_dt_s: float = 0.15
    """Shortest link whose speed is compared with the lane's, seconds: shorter ones do not tell the speed."""
    baseline_s: float = 0.7
    """Time over which the speed of a row of links is measured, seconds."""


PASSAGE_SETTINGS = PassageSettings()


@dataclass(frozen=True)
class _Links:
    """Candidate links, and the pairs (first, second) of them in which the second begins where the first ends."""

    source: IntArray
    target: IntArray
    looks: IntArray
    score: Array
    first: IntArray
    second: IntArray
    prediction: Array


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
        self._open: dict[int, tuple[float, list[int]]] = {}

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
            times = np.array([self._block, self._block + 1]) * s.block_s
            first, last = np.searchsorted(pending.times_s, times).tolist()
            low, high = np.searchsorted(pending.times_s, times + [-s.margin_s, s.margin_s]).tolist()
            source, target = _join(pending.take(slice(low, high)), s) + low
            inside = (source >= first) & (source < last)
            for i, j in zip(source[inside].tolist(), target[inside].tolist(), strict=True):
                self._sources.setdefault(j + self._offset, []).append(i + self._offset)
            ended += self._extend(pending.times_s, first, last)
            if last == len(pending):
                self._offset, self._parts = self._offset + last, []
                break
            self._block = max(self._block + 1, floor(float(pending.times_s[last]) / s.block_s))
            drop = int(np.searchsorted(pending.times_s, self._block * s.block_s - s.margin_s))
            self._offset, self._parts = self._offset + drop, [pending.take(slice(drop, None))]
        return ended

    def _extend(self, times_s: Array, first: int, last: int) -> list[IntArray]:
        """Add the sightings of a decided block to passages, and return the passages that have ended."""
        for i in range(first, last):
            number, time = i + self._offset, float(times_s[i])
            sources = self._sources.pop(number, [])
            begin, members = self._open.get(sources[0], (time, [])) if len(sources) == 1 else (time, [])
            if members and time - begin <= self.settings.max_length_s:
                self._open[number] = self._open.pop(members[-1])
                members.append(number)
            else:
                self._open[number] = time, [number]
        awaited = {i for sources in self._sources.values() for i in sources}
        over = [tail for tail in self._open if tail not in awaited]
        return [np.array(self._open.pop(tail)[1]) for tail in over]


def _join(sightings: Sightings, settings: PassageSettings) -> IntArray:
    """Return the links (2, L) of sightings, source and target, of which nothing outside of them is known."""
    links = _candidates(sightings, settings)
    links = replace(links, score=links.score + _lane_support(links, sightings, settings))
    n = len(sightings)
    after, before = np.full(n, _NONE), np.full(n, _NONE)  # link that leaves, and that reaches, each sighting
    live = np.ones(len(links.source), dtype=np.bool_)
    for margin in settings.margins:
        total, gain, lead = _totals(links, live, n, settings.rounds)
        taken = live & (gain >= settings.min_score) & (lead >= margin) & (after[links.source] == _NONE)
        new = np.flatnonzero(taken)
        after[links.source[new]], before[links.target[new]] = new, new
        follows, leads = _fitting(links, after, before)
        first = before[links.source[new]]
        clash = (first != _NONE) & ~follows[new]
        weaker = np.where(total[new] <= total[first], new, first)[clash]
        after[links.source[weaker]], before[links.target[weaker]] = _NONE, _NONE
        follows, leads = _fitting(links, after, before)
        own = np.arange(len(live))
        live &= (after[links.source] == _NONE) | (after[links.source] == own)
        live &= (before[links.target] == _NONE) | (before[links.target] == own)
        live &= (before[links.source] == _NONE) | follows
        live &= (after[links.target] == _NONE) | leads
    taken = np.sort(after[after != _NONE])
    chains = np.stack([links.source[taken], links.target[taken]])
    return np.concatenate([chains, _bridges(sightings, chains, settings)], axis=1)


def _ranges(starts: IntArray, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Return all pairs (row, number) with a number in the range [start, end) of the row."""
    counts = np.maximum(ends - starts, 0)
    rows = np.repeat(np.arange(len(starts)), counts)
    steps = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, starts[rows] + steps


def _noise_m(sightings: Sightings, settings: PassageSettings) -> Array:
    """Return the standard deviations (N, 2) of the points along and across the road, metres."""
    per_px = np.asarray(sightings.m_per_px)
    noise = np.hypot(settings.noise_m, settings.noise_px * per_px)
    return np.where(sightings.cut[:, None], np.hypot(noise, settings.cut_noise_m), noise)


def _singles(sightings: Sightings, looks: IntArray, settings: PassageSettings) -> BoolArray:
    """Return which sightings (N,) can be placed and are no second mask of a vehicle."""
    area = sightings.widths_m * sightings.heights_m
    i, j = _ranges(np.arange(len(looks)) + 1, np.searchsorted(looks, looks, side="right"))
    near = (np.abs(sightings.points_m[i] - sightings.points_m[j]) < settings.double_m).all(axis=1)
    worse = np.where(area[j] <= area[i], j, i)[near]
    usable = np.isfinite(sightings.points_m).all(axis=1) & (area > 0) & np.isfinite(area)
    usable[worse] = False
    return usable


def _pair_scores(sightings: Sightings, i: IntArray, j: IntArray, settings: PassageSettings) -> Array:
    """Return the scores (P,) of pairs of sightings by size, class and drift across the road."""
    dx, dy = (sightings.points_m[j] - sightings.points_m[i]).T
    dt = sightings.times_s[j] - sightings.times_s[i]
    noise = _noise_m(sightings, settings)[:, 1]
    spread = noise[i] ** 2 + noise[j] ** 2 + (settings.drift_ms * dt) ** 2 + (settings.heading * dx) ** 2
    whole = ~(sightings.cut[i] | sightings.cut[j])
    cost = dy**2 / spread / 2
    for size in (sightings.widths_m, sightings.heights_m):
        cost += whole * np.minimum((np.log(size[j] / size[i]) / settings.size_ratio) ** 2 / 2, settings.link_gain)
    known = (sightings.class_ids[i] != 0) & (sightings.class_ids[j] != 0)
    cost += settings.class_cost * (known & (sightings.class_ids[i] != sightings.class_ids[j]))
    excess = np.maximum(np.abs(dx / dt) - settings.usual_speed_ms, 0)
    cost += (excess / (settings.max_speed_ms - settings.usual_speed_ms) * 2) ** 2
    return np.asarray(settings.link_gain - cost)


def _candidates(sightings: Sightings, settings: PassageSettings) -> _Links:
    looks = sightings.frames // sightings.every_frame
    usable = _singles(sightings, looks, settings)
    next_looks = np.searchsorted(looks, looks, side="right")
    i, j = _ranges(next_looks, np.searchsorted(looks, looks + settings.max_missed + 1, side="right"))
    dt = sightings.times_s[j] - sightings.times_s[i]
    noise = _noise_m(sightings, settings)
    reach = settings.max_speed_ms * dt + 3 * np.hypot(noise[i, 0], noise[j, 0])
    near = np.abs(sightings.points_m[j, 0] - sightings.points_m[i, 0]) < reach
    keep = np.flatnonzero(usable[i] & usable[j] & near & (dt > 0) & (dt <= settings.max_gap_s))
    i, j = i[keep], j[keep]
    score = _pair_scores(sightings, i, j, settings) - settings.missed_cost * (looks[j] - looks[i] - 1)
    keep = np.flatnonzero(score > 0)
    i, j, score = i[keep], j[keep], score[keep]

    first, second = _ranges(np.searchsorted(i, j), np.searchsorted(i, j, side="right"))
    a, b, c = i[first], j[first], j[second]
    t1, t2 = sightings.times_s[b] - sightings.times_s[a], sightings.times_s[c] - sightings.times_s[b]
    ratio = (t2 / t1)[:, None]
    points = sightings.points_m
    error = points[c] - points[b] - ratio * (points[b] - points[a])
    spread = noise[c] ** 2 + ((1 + ratio) * noise[b]) ** 2 + (ratio * noise[a]) ** 2
    spread[:, 0] += (settings.acceleration_ms2 * t2 * (t1 + t2) / 2) ** 2
    spread[:, 1] += (settings.drift_ms * t2) ** 2
    gain = np.log(settings.false_length_m / np.sqrt(2 * np.pi * spread[:, 0]))
    prediction = (
        gain - np.minimum(error[:, 0] ** 2 / spread[:, 0], 99) / 2 - np.minimum(error[:, 1] ** 2 / spread[:, 1], 99) / 4
    )
    keep = np.flatnonzero(prediction > settings.min_prediction)
    return _Links(i, j, looks[j] - looks[i], score, first[keep], second[keep], prediction[keep])


def _fitting(links: _Links, after: IntArray, before: IntArray) -> tuple[BoolArray, BoolArray]:
    """Return which links continue the link that reaches their source, and lead to the one that leaves their target."""
    follows, leads = np.zeros((2, len(links.source)), dtype=np.bool_)
    follows[links.second[before[links.source[links.second]] == links.first]] = True
    leads[links.first[after[links.target[links.first]] == links.second]] = True
    return follows, leads


def _totals(links: _Links, live: BoolArray, n: int, rounds: int) -> tuple[Array, Array, Array]:
    """Compare rows of links.

    Returns:
        Of each link (L,) the score of the best row through it; what that is more than two rows that end at its source
        and begin at its target; and what it is more than the best row through another link of its sightings.
    """
    score = np.where(live, links.score, -np.inf)
    pairs = np.flatnonzero(live[links.first] & live[links.second])
    first, second, prediction = links.first[pairs], links.second[pairs], links.prediction[pairs]
    # Rows of links that skip frames must not reach further than the others, or they would gain as much.
    ahead, behind = np.zeros((2, rounds + 1, len(score)))
    begins, ends = np.zeros((2, rounds + 1, n))
    left = np.maximum(np.arange(rounds + 1)[:, None] - links.looks, 0)
    for horizon in range(1, rounds + 1):
        best = np.zeros((2, len(score)))
        depth = left[horizon, first]
        np.maximum.at(best[0], first, np.where(depth > 0, ahead[depth, second] + prediction, 0))
        depth = left[horizon, second]
        np.maximum.at(best[1], second, np.where(depth > 0, behind[depth, first] + prediction, 0))
        ahead[horizon], behind[horizon] = score + best
        np.maximum.at(begins[horizon], links.source, ahead[horizon])
        np.maximum.at(ends[horizon], links.target, behind[horizon])
    total = np.where(live, ahead[rounds] + behind[rounds] - links.score, -np.inf)
    apart = ends[left[rounds], links.source] + begins[left[rounds], links.target]
    rival = np.maximum(_rival(total, links.source, n), _rival(total, links.target, n))
    with np.errstate(invalid="ignore"):
        lead = np.where(live, total - rival, -np.inf)
    return total, total - apart, lead


def _rival(total: Array, group: IntArray, n: int) -> Array:
    """Return the best total (L,) among the other links of each link's group."""
    best, second = np.full(n, -np.inf), np.full(n, -np.inf)
    np.maximum.at(best, group, total)
    is_best = total == best[group]
    alone = np.bincount(group[is_best], minlength=n) == 1
    np.maximum.at(second, group[~is_best], total[~is_best])
    return np.where(is_best & alone[group], second[group], best[group])


def _lane_support(links: _Links, sightings: Sightings, settings: PassageSettings) -> Array:
    """Return by how much the speeds of other vehicles of the lane speak for each link (L,)."""
    dt = sightings.times_s[links.target] - sightings.times_s[links.source]
    told = np.flatnonzero(dt >= settings.min_speed_dt_s)
    support = np.zeros(len(dt))
    if not len(told):
        return support
    _, gain, lead = _totals(links, np.ones(len(dt), dtype=np.bool_), len(sightings), settings.rounds)
    weight = ((lead > settings.margins[-1]) & (gain > settings.min_score))[told].astype(np.float64)
    dx, y = (
        sightings.points_m[links.target[told], 0] - sightings.points_m[links.source[told], 0],
        sightings.points_m[links.source[told], 1],
    )
    edge = settings.max_speed_ms + 20
    column = np.clip(np.rint(dx / dt[told] + edge), 0, 2 * edge).astype(np.int64)
    places, row = np.unique(np.rint(y * 2) / 2, return_inverse=True)
    counts = np.zeros((len(places), int(2 * edge) + 1))
    np.add.at(counts, (row, column), weight)
    speeds = np.arange(counts.shape[1])
    near = np.exp(-(((places[:, None] - places) / settings.lane_m) ** 2) / 2)
    alike = np.exp(-(((speeds[:, None] - speeds) / settings.lane_speed_ms) ** 2) / 2)
    density = 1 / (settings.lane_speed_ms * np.sqrt(2 * np.pi))
    others = (near @ counts.sum(axis=1))[row] - weight
    like = density * ((near @ counts @ alike)[row, column] - weight)
    support[told] = np.log((1 + _SPEED_RANGE * np.maximum(like, 0)) / (1 + np.maximum(others, 0)))
    return np.clip(support, *settings.lane_support)


def _bridges(sightings: Sightings, chains: IntArray, settings: PassageSettings) -> IntArray:
    """Return further links (2, L), over longer gaps, between rows of links whose speeds are known."""
    n = len(sightings)
    previous, following = np.full(n, _NONE), np.full(n, _NONE)
    previous[chains[1]], following[chains[0]] = chains
    tails = np.flatnonzero((following == _NONE) & (previous != _NONE))
    heads = np.flatnonzero((previous == _NONE) & (following != _NONE))
    speed_i, doubt_i = _speeds(sightings, tails, previous, settings)
    speed_j, doubt_j = _speeds(sightings, heads, following, settings)
    gap = sightings.times_s[heads] - sightings.times_s[tails, None]
    a, b = np.nonzero((gap > 0) & (gap <= settings.max_gap_s))
    i, j, dt = tails[a], heads[b], gap[a, b]
    dx = sightings.points_m[j, 0] - sightings.points_m[i, 0]
    noise = _noise_m(sightings, settings)[:, 0]
    doubt = np.hypot(doubt_i[a], doubt_j[b])
    spread = noise[i] ** 2 + noise[j] ** 2 + (doubt * dt / 2) ** 2 + (settings.acceleration_ms2 * dt**2 / 4) ** 2
    error = dx - (speed_i[a] + speed_j[b]) / 2 * dt
    change = speed_j[b] - speed_i[a]
    change_spread = doubt**2 + (settings.acceleration_ms2 * (dt + settings.baseline_s)) ** 2
    score = _pair_scores(sightings, i, j, settings) - error**2 / spread / 2 - change**2 / change_spread / 2
    score += np.log(settings.false_length_m / np.sqrt(2 * np.pi * spread))
    lead = score - np.maximum(_rival(score, i, n), _rival(score, j, n))
    taken = (score >= settings.min_score) & (lead >= settings.margins[-1])
    return np.stack([i[taken], j[taken]])


def _speeds(sightings: Sightings, ends: IntArray, step: IntArray, settings: PassageSettings) -> tuple[Array, Array]:
    """Return the speeds along the road (E,) at the ends of rows of links and their standard deviations, m/s."""
    far = step[ends]
    while len(far):
        further = step[far]
        near = np.abs(sightings.times_s[further] - sightings.times_s[ends]) <= settings.baseline_s
        go_on = (further != _NONE) & near
        if not go_on.any():
            break
        far = np.where(go_on, further, far)
    dt = sightings.times_s[far] - sightings.times_s[ends]
    noise = _noise_m(sightings, settings)[:, 0]
    return (sightings.points_m[far, 0] - sightings.points_m[ends, 0]) / dt, np.hypot(noise[far], noise[ends]) / np.abs(
        dt
    )
