"""What the time stamps of a video file are worth: times, positions at a nominal rate, or nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from labelgen.media.container.counted import Counted
from labelgen.problem_counts import count_of

__all__ = ["STAMPLESS_FORMATS", "STAMP_RULES", "ClockCarry", "FileStamps", "StampRules"]

STAMPLESS_FORMATS = frozenset(
    {"h264", "hevc", "vvc", "evc", "mjpeg", "mjpeg_2000", "mpjpeg", "m4v", "mpegvideo", "h261", "h263", "cavsvideo"}
    | {"avs2", "avs3", "dirac", "dnxhd", "obu", "vc1", "rawvideo", "bitpacked", "image2", "image2pipe"}
)
"""Formats of FFmpeg that hold frames without any time: stamps that come with them are made up from a rate."""
# In these the position of a frame times a nominal rate is its time.
_COUNTED_FORMATS = frozenset({"avi", "yuv4mpegpipe"})


@dataclass(frozen=True)
class StampRules:
    """Which rates and stamps are believed."""

    max_fps: float = 240.0
    """Frames per second from which on a rate is a mistake: no traffic camera is so fast."""
    min_fps: float = 0.01
    """The same at the other end."""
    same_rate: float = 0.05
    """Share by which an announced rate may differ from that of the stamps."""
    given_rate: float = 0.01
    """Share by which a rate that the user gives may differ from that of the stamps without a note."""


STAMP_RULES = StampRules()


@dataclass(frozen=True)
class FileStamps:
    """How the stamps of a file become times.

    Args:
        base_s: seconds of one unit of the stamps.
        start: the first frame's stamp.
        fps: frames per second: given, announced or measured; None where nothing says it.
        are_times: whether stamps are used at all; without them the time of a frame is its number by `fps`.
        note: what is assumed, in words; empty where nothing is.
        untimed: why frames have no times, in words; empty where they have.
    """

    base_s: float
    start: int
    fps: float | None
    are_times: bool
    note: str = ""
    untimed: str = ""

    @classmethod
    def of(
        cls,
        container: Any,
        stream: Any,
        stamps: list[int],
        given: float | None,
        first: int | None = None,
        rules: StampRules = STAMP_RULES,
    ) -> FileStamps:
        """Judge the stamps of a file.

        Args:
            container, stream: of PyAV.
            stamps: of the first packets, in their order.
            given: frames per second that the user gives.
            first: stamp of the first frame.
            rules: thresholds.
        """
        names = set(container.format.name.split(","))
        base_s = float(stream.time_base) if stream.time_base else 0.0
        stamps = _one_run(stamps, base_s)
        start = first if first is not None else stamps[0] if stamps else 0
        announced = float(stream.average_rate or stream.guessed_rate or 0)
        if names & STAMPLESS_FORMATS or any(name.endswith("_pipe") for name in names - _COUNTED_FORMATS):
            return cls._numbered("its frames have no time stamps", given)
        believable = rules.min_fps <= announced <= rules.max_fps
        if names & _COUNTED_FORMATS:
            if given is not None and abs(given - announced) > rules.given_rate * announced:
                note = f"its header says {announced:g} frames per second; timed at the given {given:g}"
                return cls._counted(announced, given, base_s, start, stream, note)
            if believable:
                return cls._counted(announced, announced, base_s, start, stream, "")
            return cls._numbered(f"its header says {announced:g} frames per second, which cannot be", given)
        measured = _measured(stamps, base_s)
        if base_s <= 0 or (measured is None and len(stamps) > 1) or not _plausible(measured, rules):
            return cls._numbered("its time stamps cannot be those of a camera", given)
        agrees = believable and _agrees(announced, stamps, base_s, names, rules)
        fps = announced if agrees else measured
        note = ""
        if given is not None and fps is not None and abs(given - fps) > rules.given_rate * fps:
            note = f"its frames have time stamps of their own, {fps:.4g} per second; the given {given:g} is not used"
        elif announced and fps is not None and not agrees:
            note = f"its header says {announced:g} frames per second, its time stamps say {fps:.4g}, which is used"
        return cls(base_s, start, fps or given, True, note)

    @classmethod
    def _counted(cls, announced: float, fps: float, base_s: float, start: int, stream: Any, note: str) -> FileStamps:
        # With frames that refer to later ones, the positions in such a file are not those in which frames are shown.
        if getattr(stream.codec_context, "has_b_frames", False) or not base_s or not announced:
            return cls(0.0, 0, fps, False, note)
        return cls(base_s * announced / fps, start, fps, True, note)

    @classmethod
    def _numbered(cls, reason: str, fps: float | None) -> FileStamps:
        if fps is None:
            return cls(0.0, 0, None, False, "", reason)
        return cls(0.0, 0, fps, False, f"{reason}; timed at the given {fps:g} frames per second")

    def since_start_s(self, pts: int | None) -> float:
        """Return the time of a stamp since the first one, s; NaN for none."""
        return float("nan") if pts is None else (pts - self.start) * self.base_s

    def time_s(self, pts: int | None, number: int) -> float:
        """Return the time of a frame, s; NaN where nothing says it."""
        if self.are_times:
            return self.since_start_s(pts)
        return number / self.fps if self.fps else float("nan")


def _one_run(stamps: list[int], base_s: float, back_s: float = 1.0) -> list[int]:
    """Return the longest part of packets' stamps in which the clock does not start anew, sorted."""
    if len(stamps) < 2 or not base_s:
        return sorted(stamps)
    parts = np.split(np.array(stamps), np.flatnonzero(np.diff(stamps) < -back_s / base_s) + 1)
    return sorted(max(parts, key=len).tolist())


def _measured(stamps: list[int], base_s: float) -> float | None:
    """Return the frames per second of most steps between stamps; None where there are no steps."""
    steps = np.diff(stamps)
    if not len(steps) or not base_s:
        return None
    step_s = float(np.median(steps)) * base_s
    return 1 / step_s if step_s > 0 else float("inf")


def _plausible(measured: float | None, rules: StampRules) -> bool:
    return measured is None or rules.min_fps <= measured <= rules.max_fps


def _agrees(announced: float, stamps: list[int], base_s: float, names: set[str], rules: StampRules) -> bool:
    """Return whether an announced rate is that of the stamps, in the mean or for most steps."""
    if "mov" in names or len(stamps) < 3:
        return True  # made from all stamps of the file; or there is nothing to compare with
    mean = (len(stamps) - 1) / ((stamps[-1] - stamps[0]) * base_s) if stamps[-1] > stamps[0] else 0.0
    return any(rate and abs(announced - rate) <= rules.same_rate * rate for rate in (mean, _measured(stamps, base_s)))


class ClockCarry:
    """Shifts the stamps of packets so that they go on where their clock starts anew.

    Args:
        base_s: seconds of one unit of the stamps.
        period_s: time from one frame to the next, s.
        back_s: how far stamps may go back, s: packets do not come in the order in which frames are shown.
    """

    def __init__(self, base_s: float, period_s: float, back_s: float = 1.0) -> None:
        self._period = max(1, round(period_s / base_s))
        self._back = max(round(back_s / base_s), 16 * self._period)
        self._latest: int | None = None
        self._offset = 0
        self._base_s, self._jumps, self._packets = base_s, Counted(), 0

    def problems(self) -> list[str]:
        """Return how often the clock started anew, in at most one line."""
        if not self._jumps.count:
            return []
        times = f"{count_of(self._jumps.count, 'time')}"
        where = f"by {self._jumps.first_size:.1f} s near frame {self._jumps.first}"
        return [f"the clock jumped back {times} (first: {where}); the time is carried on"]

    def carried(self, packets: Iterable[Any]) -> Iterator[Any]:
        """Yield packets, each when the next one has come: a single stamp out of line is no new start of the clock."""
        coming = iter(packets)
        packet = next(coming, None)
        while packet is not None:
            following = next(coming, None)
            self._packets += 1
            if packet.pts is not None:
                self._update(packet.pts, None if following is None else following.pts)
                packet.pts += self._offset
                if packet.dts is not None:
                    packet.dts += self._offset
            yield packet
            packet = following

    def _update(self, pts: int, following: int | None) -> None:
        here, latest = pts + self._offset, self._latest
        after = None if following is None else following + self._offset
        if latest is None:
            self._latest = here
        elif here < latest - self._back:
            if after is None or after < latest - self._back:
                self._jumps.add(self._packets, (latest - here) * self._base_s)
                self._offset += latest + self._period - here
                self._latest = latest + self._period
        elif here <= latest + self._back or after is None or after >= here - self._back:
            self._latest = max(latest, here)
