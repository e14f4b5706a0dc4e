"""What the time stamps of a video file are worth: times, positions at a nominal rate, or nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

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
            stamps: of the first packets, sorted.
            given: frames per second that the user gives.
            first: stamp of the first frame.
            rules: thresholds.
        """
        names = set(container.format.name.split(","))
        base_s = float(stream.time_base) if stream.time_base else 0.0
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

    def jumps_back(self, pts: int | None) -> bool:
        """Return whether a packet's stamp lies far before the latest one."""
        return pts is not None and self._latest is not None and pts + self._offset < self._latest - self._back

    def restart(self, pts: int, following: int | None) -> None:
        """Carry the clock on from a packet whose stamp jumps back, unless the following packet's does not."""
        assert self._latest is not None
        if following is None or self.jumps_back(following):
            self._offset = self._latest + self._period - pts

    def shift(self, packet: Any) -> None:
        """Shift the stamps of a packet."""
        if packet.pts is None:
            return
        packet.pts += self._offset
        if packet.dts is not None:
            packet.dts += self._offset
        if not self.jumps_back(packet.pts - self._offset):
            self._latest = packet.pts if self._latest is None else max(self._latest, packet.pts)
