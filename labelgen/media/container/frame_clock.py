"""Times of frames, from time stamps that may be wrong, or from the moments at which frames arrive.

Convention: times are seconds since the first frame and increase from frame to frame.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from labelgen.media.container.counted import Counted
from labelgen.problem_counts import count_of

__all__ = ["ArrivalClock", "ArrivalClockRules", "FrameClock", "FrameClockRules", "TimedItem"]

_Item = TypeVar("_Item")


class TimedItem(NamedTuple, Generic[_Item]):
    """A frame with its time.

    Args:
        number: of the frame.
        time_s: s since the first frame.
        gaps_s: how much of it lies in gaps of the recording, s.
        item: whatever came with the frame.
    """

    number: int
    time_s: float
    gaps_s: float
    item: _Item


@dataclass(frozen=True)
class FrameClockRules:
    """What counts as a gap of the recording."""

    gap_s: float = 2.0
    """Least length of a gap, s; shorter ones are frames that were dropped on the way."""
    gap_frames: float = 10.0
    """Least length of a gap in frames: a recording of few frames per second has no gap between any two of them."""


class FrameClock:
    """Times of frames by their time stamps, which are not trusted one by one.

    A stamp that lies outside those of its neighbours, or is missing, is replaced by a time between them. Where the
    stamps jump back and go on from there, as in recordings put together, the time is carried on.

    Args:
        period_s: expected time from one frame to the next, s; None takes it from the stamps.
        rules: thresholds.
    """

    def __init__(self, period_s: float | None, rules: FrameClockRules | None = None) -> None:
        self._rules = rules or FrameClockRules()
        self._period_s = period_s or 0.0
        self._last: tuple[int, float] | None = None
        self._offset_s = 0.0
        self._outliers, self._jumps, self._gaps = Counted(), Counted(), Counted()

    def timed(self, frames: Iterable[tuple[int, float, _Item]]) -> Iterator[TimedItem[_Item]]:
        """Yield frames with their times, each when the next one has come.

        Args:
            frames: number, time stamp in s (NaN where there is none) and anything else.
        """
        coming = iter(frames)
        frame = next(coming, None)
        while frame is not None:
            following = next(coming, None)
            number, stamp_s, item = frame
            time_s = self._time_s(number, stamp_s, None if following is None else following[:2])
            yield TimedItem(number, time_s, self._gaps.total, item)
            frame = following

    def _time_s(self, number: int, stamp_s: float, following: tuple[int, float] | None) -> float:
        next_number, next_s = (number + 1, math.nan) if following is None else following
        if self._last is None:
            if not math.isfinite(stamp_s) or next_s < stamp_s:
                self._outliers.add(number)
                stamp_s = next_s - self._period_s * (next_number - number) if math.isfinite(next_s) else 0.0
            self._offset_s = -stamp_s
            self._last = number, 0.0
            return 0.0
        last_number, last_s = self._last
        here_s, next_s = stamp_s + self._offset_s, next_s + self._offset_s
        step_s = (self._period_s or 0.04) * (number - last_number)
        if here_s > last_s and not last_s < next_s < here_s:
            time_s = here_s
            self._period_s = self._period_s or (time_s - last_s) / (number - last_number)
        elif next_s > last_s:
            time_s = last_s + (next_s - last_s) * (number - last_number) / (next_number - last_number)
            self._outliers.add(number)
        else:
            time_s = last_s + step_s
            if next_s > here_s:
                self._jumps.add(number, last_s - here_s)
                self._offset_s += time_s - here_s
            else:
                self._outliers.add(number)
        surplus_s = time_s - last_s - step_s
        if surplus_s > max(self._rules.gap_s, self._rules.gap_frames * step_s):
            self._gaps.add(number, surplus_s)
        self._last = number, time_s
        return time_s

    def problems(self) -> list[str]:
        """Return what was wrong with the stamps, one line for each kind."""
        lines = []
        if self._outliers.count:
            stamps = count_of(self._outliers.count, "time stamp")
            lines.append(
                f"{stamps} missing or out of line, replaced by a time between the neighbours' "
                f"(first: frame {self._outliers.first})"
            )
        if self._jumps.count:
            first = f"by {self._jumps.first_size:.1f} s at frame {self._jumps.first}"
            times = count_of(self._jumps.count, "time")
            lines.append(f"the clock jumped back {times} (first: {first}); the time is carried on")
        return [*lines, *_gap_lines(self._gaps)]


@dataclass(frozen=True)
class ArrivalClockRules:
    """How the moments of arrival are smoothed."""

    burst_s: float = 0.005
    """Frames at the beginning that arrive closer together than this were waiting, s."""
    learn_s: float = 1.5
    """Frames are held back until arrivals over this time give the first frame rate, s; longer is more accurate."""
    learn_frames: int = 8
    """Least number of arrivals that give a frame rate."""
    window_frames: int = 200
    """Number of last arrivals that give the frame rate; more are more accurate and follow changes later."""
    pull: float = 0.05
    """Share of the difference between arrival and expected time by which each time is corrected."""
    max_pull_frames: float = 0.005
    """Largest correction, in frames: it is also the largest error of a speed through corrections."""
    gap_s: float = 1.0
    """Delay from which a frame counts as the first after a pause, s; shorter ones are delays of the network."""
    gap_frames: float = 5.0
    """The same in frames."""


class ArrivalClock:
    """Times of frames by the moments at which they arrive, smoothed: networks deliver in bursts.

    Args:
        fps: frames per second, where it is known; then only pauses are taken from the arrivals.
        rules: thresholds.

    Attributes:
        fps: frames per second, as far as it is known.
    """

    def __init__(self, fps: float | None = None, rules: ArrivalClockRules | None = None) -> None:
        self.fps, self._fixed = fps, fps is not None
        self._rules = rules or ArrivalClockRules()
        self._arrivals: deque[float] = deque(maxlen=self._rules.window_frames)
        self._base_s = math.nan
        self._last_s = 0.0
        self._gaps = Counted()

    def timed(self, frames: Iterable[tuple[int, float, _Item]]) -> Iterator[TimedItem[_Item]]:
        """Yield frames with their times; the first ones are held back until the frame rate is known.

        Args:
            frames: number, moment of arrival in s on any clock, and anything else.
        """
        coming = iter(frames)
        held: list[tuple[int, float, _Item]] = []
        live: list[float] = []
        for frame in coming:
            held.append(frame)
            live = self._live([arrival for _, arrival, _ in held])
            if self._fixed or (len(live) >= self._rules.learn_frames and live[-1] - live[0] >= self._rules.learn_s):
                break
        self._begin(held, live)
        for count, (number, _, item) in enumerate(held):
            self._last_s = count / (self.fps or 25.0)
            yield TimedItem(number, self._last_s, 0.0, item)
        for number, arrival_s, item in coming:
            yield TimedItem(number, self._next_s(number, arrival_s), self._gaps.total, item)

    def _live(self, arrivals: list[float]) -> list[float]:
        """Return the arrivals after those that were waiting when the stream was opened."""
        for count, (before, after) in enumerate(pairwise(arrivals), start=1):
            if after - before >= self._rules.burst_s:
                return arrivals[count:]
        return []

    def _begin(self, held: list[tuple[int, float, _Item]], live: list[float]) -> None:
        if not self._fixed and len(live) > 1 and live[-1] > live[0]:
            self.fps = (len(live) - 1) / (live[-1] - live[0])
            self._arrivals.extend(live)
            if len(live) >= self._rules.learn_frames:
                self.fps = 1 / self._period_s()
        if held:
            # The mean difference between arrival and time, so that single delays do not count as pauses.
            first = len(held) - len(live) if live else len(held) - 1
            expected = np.arange(first, len(held)) / (self.fps or 25.0)
            self._base_s = float(np.mean([arrival for _, arrival, _ in held[first:]] - expected))

    def _period_s(self) -> float:
        """Return the period as the median over half the window: single delays change it little."""
        arrivals = np.array(self._arrivals)
        half = len(arrivals) // 2
        return float(np.median(arrivals[half : 2 * half] - arrivals[:half])) / half

    def _next_s(self, number: int, arrival_s: float) -> float:
        rules = self._rules
        period_s = 1 / (self.fps or 25.0)
        expected_s = self._last_s + period_s
        if math.isnan(self._base_s):
            self._base_s = arrival_s - expected_s
        late_s = arrival_s - self._base_s - expected_s
        if late_s > max(rules.gap_s, rules.gap_frames * period_s):
            self._gaps.add(number, late_s)
            self._arrivals.clear()
            self._last_s = expected_s + late_s
        elif self._fixed:
            self._last_s = expected_s
        else:
            most_s = rules.max_pull_frames * period_s
            self._last_s = expected_s + min(max(rules.pull * late_s, -most_s), most_s)
        self._arrivals.append(arrival_s)
        spans_s = self._arrivals[-1] - self._arrivals[0]
        if not self._fixed and len(self._arrivals) >= 2 * rules.learn_frames and spans_s >= rules.learn_s:
            self.fps = 1 / max(self._period_s(), 1e-3)
        return self._last_s

    def problems(self) -> list[str]:
        """Return the pauses, in at most one line."""
        return _gap_lines(self._gaps)


def _gap_lines(gaps: Counted) -> list[str]:
    if not gaps.count:
        return []
    together = f", {gaps.total:.1f} s together" if gaps.count > 1 else ""
    first = f"{gaps.first_size:.1f} s before frame {gaps.first}"
    return [f"{count_of(gaps.count, 'gap')} in the recording{together} (first: {first})"]
