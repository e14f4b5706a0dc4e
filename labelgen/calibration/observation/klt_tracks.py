"""Tracks of corner features on what moves, followed frame by frame with optical flow.

Frames are worked on at a small size: a feature that is followed across half of the frame gives its direction to a
hundredth of a degree even there.

Source: Shi & Tomasi 1994, Bouguet 2000 (KLT); their use for VP1: Dubska et al., BMVC 2014.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array
from labelgen.media.klt import Grey, KltSettings, optical_flow

__all__ = ["FeatureTracker", "FeatureTrackerSettings", "Track", "working_factor"]


@dataclass(frozen=True)
class FeatureTrackerSettings:
    """How features are found and followed; px are those of the shrunken frames."""

    working_width_px: int = 640
    """Frames are shrunk by a whole number to about this width; larger ones cost time and give more short tracks."""
    max_features: int = 140
    """Features followed at once; more cost time."""
    seed_every: int = 3
    """New features are looked for in every so many frames."""
    spacing_px: int = 9
    """Least distance between features."""
    min_quality: float = 0.02
    """Least quality of a new corner, as a share of the best one's."""
    block_px: int = 5
    """Side of the window in which a corner is judged."""
    moving_levels: int = 14
    """Grey levels by which a pixel must change to count as moving; lower values take noise for motion."""
    opening_px: int = 2
    """Specks of motion narrower than this are noise."""
    seed_dilation_px: int = 5
    """Odd size by which moving pixels are widened before corners are looked for: corners lie at their border."""
    margin_px: int = 4
    """Features nearer to the border than this end: the window leaves the frame."""
    min_motion_px: float = 1.0
    """A feature that moves by less over `rest_frames` frames sits on the background and ends."""
    rest_frames: int = 6
    """Frames over which the least motion is measured."""
    max_backward_px: float = 0.7
    """Largest error of following a feature back again; larger values keep features that jumped."""
    min_turn_cos: float = 0.85
    """Least cosine between successive steps of a feature; vehicles do not turn more sharply."""
    min_turn_px2: float = 4.0
    """Steps are compared from this product of their lengths on, px^2; shorter ones are noise."""
    min_points: int = 4
    """Tracks of fewer points are dropped."""
    min_extent_px: float = 16.0
    """Tracks of a smaller extent are dropped; they give no direction."""
    max_tracks: int = 6000
    """Above this number every second track is dropped, and every second new one from then on: memory."""
    backward_levels: int = 1
    """Pyramid levels of the backward check, which starts near the answer."""
    flow: KltSettings = field(default_factory=KltSettings)
    """Of the optical flow."""


def working_factor(size_wh: tuple[int, int], settings: FeatureTrackerSettings | None = None) -> int:
    """Return the whole number by which frames of this size are shrunk to be tracked on."""
    return max(1, round(size_wh[0] / (settings or FeatureTrackerSettings()).working_width_px))


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
class _LiveTrack:
    points: list[NDArray[np.float32]] = field(default_factory=list)
    times: list[float] = field(default_factory=list)


class FeatureTracker:
    """Follow features on moving things.

    Args:
        factor: full-frame px per px of the frames given; tracks are in full-frame px.
        settings: thresholds.

    Attributes:
        tracks: finished tracks, in order of their end.
        moving: (h, w) uint8, 1 where the last two frames differ; None before the second.
    """

    def __init__(self, factor: int, settings: FeatureTrackerSettings | None = None) -> None:
        self.tracks: list[Track] = []
        self.moving: Grey | None = None
        self._settings = settings or FeatureTrackerSettings()
        self._factor = factor
        self._previous: Grey | None = None
        self._previous_smooth: Grey
        self._live: list[_LiveTrack]
        # Of each the latest points, the first one again where there are fewer, and how many there are.
        self._recent: NDArray[np.float32]
        self._ages: NDArray[np.int64]
        self._clear()
        self._count = self._thinned = 0
        self._frames = 0

    def update(self, grey: Grey, time_s: float) -> None:
        """Take the next frame, (h, w) uint8, of the small size."""
        smooth = np.asarray(cv2.blur(grey, (3, 3)), dtype=np.uint8)
        if self._previous is not None:
            if self._live:
                self._follow(grey, time_s)
            difference = cv2.absdiff(smooth, self._previous_smooth)
            self.moving = np.asarray(difference > self._settings.moving_levels, dtype=np.uint8)
            if self._frames % self._settings.seed_every == 0 and len(self._live) < self._settings.max_features:
                self._seed(grey, time_s)
        self._previous, self._previous_smooth = grey, smooth
        self._frames += 1

    def pause(self) -> None:
        """Finish all tracks: the next frame does not follow closely on the last one."""
        for live in self._live:
            self._finish(live)
        self._previous = self.moving = None
        self._clear()

    def _clear(self) -> None:
        """Drop all features that are followed."""
        self._live = []
        self._recent = np.empty((0, self._settings.rest_frames, 2), dtype=np.float32)
        self._ages = np.empty(0, dtype=np.int64)

    def _follow(self, grey: Grey, time_s: float) -> None:
        assert self._previous is not None
        settings = self._settings
        last = self._recent[:, -1].copy()
        guess = np.where(self._ages[:, None] > 1, 2 * last - self._recent[:, -2], last)
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW
        forward, ahead_status = optical_flow(
            self._previous, grey, last, guess, settings.flow, levels=settings.flow.levels, flags=flags
        )
        now = np.asarray(forward, dtype=np.float32)
        back, back_status = optical_flow(
            grey, self._previous, now, last.copy(), settings.flow, levels=settings.backward_levels, flags=flags
        )
        good = (ahead_status[:, 0] > 0) & (back_status[:, 0] > 0)
        good &= np.abs(back - last).max(axis=1) < settings.max_backward_px
        high = np.array(grey.shape[::-1]) - 1 - settings.margin_px
        good &= ((now > settings.margin_px) & (now < high)).all(axis=1)
        good &= _moves_on(self._recent, self._ages, now, settings)
        for live, point, keep in zip(self._live, now, good.tolist(), strict=True):
            if keep:
                live.points.append(point)
                live.times.append(time_s)
            else:
                self._finish(live)
        self._live = [live for live, keep in zip(self._live, good.tolist(), strict=True) if keep]
        self._recent = np.concatenate([self._recent[good, 1:], now[good, None]], axis=1)
        self._ages = self._ages[good] + 1

    def _seed(self, grey: Grey, time_s: float) -> None:
        assert self.moving is not None
        settings = self._settings
        opening, dilation = (np.ones((n, n), np.uint8) for n in (settings.opening_px, settings.seed_dilation_px))
        core = cv2.morphologyEx(self.moving, cv2.MORPH_OPEN, opening)
        x, y, w, h = cv2.boundingRect(core)
        if w == 0:
            return
        mask = cv2.dilate(core, dilation)
        for live in self._live:
            place = round(float(live.points[-1][0])), round(float(live.points[-1][1]))
            cv2.circle(mask, place, settings.spacing_px, 0, -1)
        part = np.s_[y : y + h, x : x + w]
        corners = cv2.goodFeaturesToTrack(
            grey[part],
            settings.max_features - len(self._live),
            settings.min_quality,
            settings.spacing_px,
            mask=mask[part],
            blockSize=settings.block_px,
        )
        if corners is not None:
            points = corners[:, 0] + np.array([x, y], dtype=np.float32)
            self._live += [_LiveTrack([point], [time_s]) for point in points]
            self._recent = np.concatenate([self._recent, np.repeat(points[:, None], settings.rest_frames, axis=1)])
            self._ages = np.concatenate([self._ages, np.ones(len(points), dtype=np.int64)])

    def _finish(self, live: _LiveTrack) -> None:
        settings = self._settings
        points = np.array(live.points, dtype=np.float64)
        if len(points) < settings.min_points or np.hypot(*np.ptp(points, axis=0)) < settings.min_extent_px:
            return
        self._count += 1
        if self._count % 2**self._thinned:
            return
        # Pixel centres are at whole numbers for OpenCV and at halves here.
        self.tracks.append(Track(np.array(live.times), (points + 0.5) * self._factor))
        if len(self.tracks) > settings.max_tracks:
            self.tracks = self.tracks[::2]
            self._thinned += 1


def _moves_on(
    recent: NDArray[np.float32], ages: NDArray[np.int64], now: NDArray[np.float32], settings: FeatureTrackerSettings
) -> NDArray[np.bool_]:
    """(N,) whether tracks neither rest nor turn sharply on the way to their next points.

    Args:
        recent: (N, K, 2) px, latest points of each.
        ages: (N,) how many points each has.
        now: (N, 2) px, next points.
        settings: thresholds.
    """
    rests = ages >= settings.rest_frames
    rests &= np.abs(now - recent[:, 0]).max(axis=1) < settings.min_motion_px
    old, new = recent[:, -1] - recent[:, -3], now - recent[:, -2]
    lengths = np.hypot(*old.T) * np.hypot(*new.T)
    turns = (ages >= 3) & (lengths >= settings.min_turn_px2)
    turns &= (old * new).sum(axis=1) <= settings.min_turn_cos * lengths
    return np.asarray(~rests & ~turns)
