"""Tracks of features on what moves, and whether the camera itself moves; fed frame by frame.

Frames are worked on at a small size: a feature that is followed across half of the picture tells its direction to a
hundredth of a degree even there.

Source: Shi & Tomasi 1994, Bouguet 2000 (KLT); their use for VP1: Dubska et al., BMVC 2014.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = ["CameraShake", "FeatureTracker", "Track", "working_factor"]

Grey = NDArray[np.uint8]
WORKING_WIDTH = 640
_MAX_FEATURES = 140
_SEED_EVERY = 3
_SPACING = 9
_MOVED_LEVELS = 14
_MARGIN = 4
# A feature that has not moved by this much during this many frames sits on the background.
_STILL_PX, _STILL_FRAMES = 1.0, 6
_BACKWARD_PX = 0.7
_TURN_COS = 0.85
_KLT: dict[str, Any] = {
    "winSize": (15, 15),
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.02),
    "minEigThreshold": 1e-3,
}


def working_factor(size_wh: tuple[int, int]) -> int:
    """By how much frames of this size are shrunk to be tracked on."""
    return max(1, round(size_wh[0] / WORKING_WIDTH))


@dataclass(frozen=True, eq=False)
class Track:
    """One feature on something that moves.

    Args:
        times_s: (K,) seconds.
        points_px: (K, 2) px of the full frame, pixels as areas.
    """

    times_s: Array
    points_px: Array


@dataclass
class _Live:
    points: list[NDArray[np.float32]] = field(default_factory=list)
    times: list[float] = field(default_factory=list)


class FeatureTracker:
    """Follows features on moving things with KLT.

    Args:
        factor: by how much the frames given were shrunk; tracks are in full-frame px.
        shortest_px: tracks of a smaller extent, in px of the small frames, are forgotten.
        most: how many tracks are kept; from then on every second one is dropped and half of the new ones taken.

    Attributes:
        tracks: the finished ones, in order of their end.
        moving: (h, w) uint8, 1 where the last two frames differ; None before the second.
    """

    def __init__(self, factor: int, *, shortest_px: float = 16.0, most: int = 6000) -> None:
        self.tracks: list[Track] = []
        self.moving: Grey | None = None
        self._factor, self._shortest, self._most = factor, shortest_px, most
        self._previous: Grey | None = None
        self._previous_smooth: Grey
        self._live: list[_Live]
        # Of each the latest points, the first one again where there are fewer, and how many there are.
        self._recent: NDArray[np.float32]
        self._ages: NDArray[np.int64]
        self._forget()
        self._count = self._thinned = 0
        self._frames = 0

    def see(self, grey: Grey, time_s: float) -> None:
        """Take the next frame, (h, w) uint8, of the small size."""
        smooth = np.asarray(cv2.blur(grey, (3, 3)), dtype=np.uint8)
        if self._previous is not None:
            if self._live:
                self._follow(grey, time_s)
            difference = cv2.absdiff(smooth, self._previous_smooth)
            self.moving = np.asarray(difference > _MOVED_LEVELS, dtype=np.uint8)
            if self._frames % _SEED_EVERY == 0 and len(self._live) < _MAX_FEATURES:
                self._seed(grey, time_s)
        self._previous, self._previous_smooth = grey, smooth
        self._frames += 1

    def pause(self) -> None:
        """Finish all tracks: the next frame does not follow closely on the last one."""
        for live in self._live:
            self._finish(live)
        self._previous = self.moving = None
        self._forget()

    def _forget(self) -> None:
        """Nothing is followed."""
        self._live = []
        self._recent = np.empty((0, _STILL_FRAMES, 2), dtype=np.float32)
        self._ages = np.empty(0, dtype=np.int64)

    def _follow(self, grey: Grey, time_s: float) -> None:
        assert self._previous is not None
        last = self._recent[:, -1].copy()
        guess = np.where(self._ages[:, None] > 1, 2 * last - self._recent[:, -2], last)
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW
        ahead, found, _ = cv2.calcOpticalFlowPyrLK(self._previous, grey, last, guess, maxLevel=4, flags=flags, **_KLT)
        now = np.asarray(ahead, dtype=np.float32)
        back, again, _ = cv2.calcOpticalFlowPyrLK(
            grey, self._previous, now, last.copy(), maxLevel=1, flags=flags, **_KLT
        )
        good = (found[:, 0] > 0) & (again[:, 0] > 0) & (np.abs(back - last).max(axis=1) < _BACKWARD_PX)
        high = np.array(grey.shape[::-1]) - 1 - _MARGIN
        good &= ((now > _MARGIN) & (now < high)).all(axis=1) & _goes_on(self._recent, self._ages, now)
        for live, point, fine in zip(self._live, now, good.tolist(), strict=True):
            if fine:
                live.points.append(point)
                live.times.append(time_s)
            else:
                self._finish(live)
        self._live = [live for live, fine in zip(self._live, good.tolist(), strict=True) if fine]
        self._recent = np.concatenate([self._recent[good, 1:], now[good, None]], axis=1)
        self._ages = self._ages[good] + 1

    def _seed(self, grey: Grey, time_s: float) -> None:
        assert self.moving is not None
        core = cv2.morphologyEx(self.moving, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        x, y, w, h = cv2.boundingRect(core)
        if w == 0:
            return
        mask = cv2.dilate(core, np.ones((5, 5), np.uint8))
        for live in self._live:
            cv2.circle(mask, (round(float(live.points[-1][0])), round(float(live.points[-1][1]))), _SPACING, 0, -1)
        part = np.s_[y : y + h, x : x + w]
        corners = cv2.goodFeaturesToTrack(
            grey[part], _MAX_FEATURES - len(self._live), 0.02, _SPACING, mask=mask[part], blockSize=5
        )
        if corners is not None:
            points = corners[:, 0] + np.array([x, y], dtype=np.float32)
            self._live += [_Live([point], [time_s]) for point in points]
            self._recent = np.concatenate([self._recent, np.repeat(points[:, None], _STILL_FRAMES, axis=1)])
            self._ages = np.concatenate([self._ages, np.ones(len(points), dtype=np.int64)])

    def _finish(self, live: _Live) -> None:
        points = np.array(live.points, dtype=np.float64)
        if len(points) < 4 or np.hypot(*np.ptp(points, axis=0)) < self._shortest:
            return
        self._count += 1
        if self._count % 2**self._thinned:
            return
        # Pixel centres are at whole numbers for OpenCV and at halves here.
        self.tracks.append(Track(np.array(live.times), (points + 0.5) * self._factor))
        if len(self.tracks) > self._most:
            self.tracks = self.tracks[::2]
            self._thinned += 1


def _goes_on(recent: NDArray[np.float32], ages: NDArray[np.int64], now: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) whether tracks go on to their next points: they neither rest nor turn sharply.

    Args:
        recent: (N, K, 2) latest points of each.
        ages: (N,) how many points each has.
        now: (N, 2) next points.
    """
    rests = (ages >= _STILL_FRAMES) & (np.abs(now - recent[:, 0]).max(axis=1) < _STILL_PX)
    old, new = recent[:, -1] - recent[:, -3], now - recent[:, -2]
    lengths = np.hypot(*old.T) * np.hypot(*new.T)
    turns = (ages >= 3) & (lengths >= 4.0) & ((old * new).sum(axis=1) <= _TURN_COS * lengths)
    return np.asarray(~rests & ~turns)


class CameraShake:
    """Whether the camera moves: corners all over the picture against those of some seconds before.

    Attributes:
        shifts_px: by how much all but a quarter of the corners had moved at each look, px of the small frames;
            infinite where they are gone.
        drift_px: the greatest displacement since the beginning, without jumps.
    """

    _REFRESH = 8
    _GRID = 8
    # Corners in fewer fields than these may all be on vehicles.
    _FEWEST = 12

    def __init__(self) -> None:
        self.shifts_px: list[float] = []
        self._drift = np.zeros(2)
        self.drift_px = 0.0
        self._reference: Grey | None = None
        self._corners = np.empty((0, 1, 2), dtype=np.float32)
        self._fields = self._looks = 0

    def see(self, grey: Grey) -> None:
        """Look at a frame, (h, w) uint8; call it a few times per second."""
        if self._reference is not None and self._fields >= self._FEWEST:
            now, found, _ = cv2.calcOpticalFlowPyrLK(
                self._reference, grey, self._corners, self._corners.copy(), maxLevel=4, **_KLT
            )
            held = found[:, 0] > 0
            moved = (now - self._corners)[held].reshape(-1, 2)
            lost = held.mean() < 0.3
            # Corners on vehicles may be many; on a camera that moves even the slowest quarter moves.
            size = np.hypot(*moved.T)
            self.shifts_px.append(np.inf if lost else float(np.quantile(size, 0.25)))
            if self._looks % self._REFRESH == 0 and not lost:
                self._drift += np.median(moved[size <= np.median(size)], axis=0)
                self.drift_px = max(self.drift_px, float(np.hypot(*self._drift)))
        if self._looks % self._REFRESH == 0:
            fields = self._spread(grey)
            self._reference, self._fields = grey, len(fields)
            self._corners = np.concatenate([np.empty((0, 1, 2), dtype=np.float32), *fields])
        self._looks += 1

    def _spread(self, grey: Grey) -> list[NDArray[np.float32]]:
        """A corner from each field of a grid, so that no textured part of the picture outvotes the rest."""
        h, w = (n // self._GRID for n in grey.shape)
        found = []
        for row in range(self._GRID):
            for column in range(self._GRID):
                part = grey[row * h : (row + 1) * h, column * w : (column + 1) * w]
                corners = cv2.goodFeaturesToTrack(part, 1, 0.1, 10, blockSize=5)
                if corners is not None and part.std() > 3:
                    found.append(np.asarray(corners + np.array([column * w, row * h]), dtype=np.float32))
        return found
