"""One pass over a video: everything that calibration needs is gathered frame by frame, in bounded memory."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.background_image import BackgroundImageEstimator, BackgroundImageSettings
from labelgen.calibration.observation.camera_shake import CameraShake, CameraShakeSettings
from labelgen.calibration.observation.edgelets import EdgeletFinder, EdgeletSettings
from labelgen.calibration.observation.klt_tracks import FeatureTracker, FeatureTrackerSettings, Track, working_factor
from labelgen.calibration.observation.silhouettes import SilhouetteCollector
from labelgen.errors import DataError
from labelgen.geometry.homography import Array
from labelgen.media.frames import Frame, FrameSource
from labelgen.progress import progress_bar

__all__ = ["ObservationSettings", "Observations", "observe"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ObservationSettings:
    """Which frames of a video are worked on, and what is gathered from them."""

    track_fps: float = 15.0
    """Frames per second on which features are followed; more cost time, with fewer fast vehicles are lost."""
    default_fps: float = 25.0
    """Frame rate where the source states none."""
    max_gap_frames: float = 2.5
    """A gap of more tracking periods than this ends all tracks: vehicles move too far to be followed over it."""
    sample_interval_s: float = 0.4
    """Time between frames used for edges, silhouettes and camera motion: vehicles look alike a frame later."""
    interval_tolerance: float = 0.9
    """Share of the interval after which a frame is on time: frame times are uneven."""
    max_lead_frames: float = 2.0
    """Frames by which times may differ from numbers before the difference is taken into account."""
    stretch_s: float = 3.0
    """Length of the stretches of video that are worked on or skipped; a vehicle passes in about one of them."""
    sparse_from: tuple[tuple[int, int], ...] = ((250, 2000), (1000, 8000))
    """Numbers of tracks and edgelets, together, from which on half and then a quarter of the stretches are worked on:
    more of the same traffic adds little, while traffic of another time adds more."""
    first_check_s: float = 30.0
    """Time of the video at which it is first asked whether the observations are enough."""
    check_growth: float = 1.6
    """Factor from one such time to the next; each check costs an estimate of the orientation."""
    features: FeatureTrackerSettings = field(default_factory=FeatureTrackerSettings)
    """Of the tracks."""
    shake: CameraShakeSettings = field(default_factory=CameraShakeSettings)
    """Of the camera's motion."""
    edgelets: EdgeletSettings = field(default_factory=EdgeletSettings)
    """Of the edges."""
    background: BackgroundImageSettings = field(default_factory=BackgroundImageSettings)
    """Of the background image."""


@dataclass(frozen=True, eq=False)
class Observations:
    """What one pass over a video gave.

    Args:
        size_wh: px of the frames.
        fps: frame rate; None where the source states none.
        duration_s: how much of the video was shown up to the last frame used, seconds.
        tracks: features on moving things, in order of their end.
        edgelets: (N, 5) straight edges on moving things: x0, y0, x1, y1 in px, and time in seconds.
        shifts: (L,) displacement of the camera within a few seconds, per sampled frame, as a share of the frame's
            width.
        drift: displacement of the camera over the whole pass, as a share of the frame's width.
        background: (H, W, 3) uint8 RGB, the empty road, full size; None where it could not be estimated.
        ended: whether the pass reached the video's end (or the duration asked for) instead of stopping early.
    """

    size_wh: tuple[int, int]
    fps: float | None
    duration_s: float
    tracks: Sequence[Track]
    edgelets: Array
    shifts: Array
    drift: float
    background: NDArray[np.uint8] | None
    ended: bool


def observe(
    source: FrameSource,
    *,
    duration_s: float | None = None,
    silhouettes: SilhouetteCollector | None = None,
    enough: Callable[[Observations], bool] | None = None,
    settings: ObservationSettings | None = None,
) -> Observations:
    """Gather tracks, edges, camera motion and the background image in one pass over a video.

    Args:
        source: the frames.
        duration_s: length of the video's beginning to use, seconds; None for all of it.
        silhouettes: is given the sampled frames too; None where silhouettes are not needed.
        enough: called now and then, ever more rarely, with the observations so far; True ends the pass.
        settings: thresholds.

    Raises:
        DataError: no frame came.
    """
    settings = settings or ObservationSettings()
    observation_pass = _ObservationPass(source.size_wh, silhouettes, settings)
    fps = source.fps or settings.default_fps
    if source.untimed:
        _log.info("%s: %s; %g frames per second are assumed", source.name, source.untimed, fps)
    count = source.frame_count
    if duration_s is not None:
        count = min(count or 2**31, math.ceil(duration_s * fps))
    step = max(1, round(fps / settings.track_fps))
    frames_read, shown_s, check_s, ended = 0, 0.0, settings.first_check_s, True
    gaps_s = 0.0
    lead_s = 0.0  # by how much what is shown is ahead of the frames' numbers, with an uneven frame rate
    with progress_bar(count, "frame", "watching") as advance:
        sampler = _StretchSampler(settings.stretch_s)
        frames = source.frames(
            lambda n: n % step == 0 and n / fps + lead_s >= sampler.next_s, lambda: sampler.next_s + gaps_s
        )
        for frame in frames:
            time_s = frame.time_s if math.isfinite(frame.time_s) else frame.number / fps
            gaps_s = frame.gaps_s
            shown_s = time_s - gaps_s
            if abs(shown_s - frame.number / fps - lead_s) > settings.max_lead_frames / fps:
                lead_s = shown_s - frame.number / fps
            if duration_s is not None and shown_s >= duration_s:
                break
            sampler.update(shown_s, observation_pass.stretch_period())
            observation_pass.update(frame, time_s)
            advance(frame.number + 1 - frames_read)
            frames_read = frame.number + 1
            if enough is not None and shown_s >= check_s:
                check_s *= settings.check_growth
                if enough(observation_pass.observations(source, shown_s, ended=False)):
                    ended = False
                    break
    if not frames_read:
        raise DataError(f"{source.path}: no frame could be read; is it a video?")
    background = observation_pass.finish()
    return observation_pass.observations(source, shown_s, ended=ended, background=background)


class _StretchSampler:
    """Choose which stretches of a video are worked on.

    Args:
        stretch_s: length of a stretch, seconds.

    Attributes:
        next_s: frames before this time are skipped.
    """

    def __init__(self, stretch_s: float) -> None:
        self.next_s = self._begin_s = self._last_s = 0.0
        self._stretch_s = self._length_s = stretch_s

    def update(self, time_s: float, period: int) -> None:
        """Take the time of a frame that is worked on, seconds; of `period` stretches one is to be worked on."""
        if time_s > self._last_s + self._stretch_s / 2:
            # A seek may skip more than was asked for; the stretch after it is longer then as well.
            self._begin_s = time_s
            self._length_s = max(self._stretch_s, (time_s - self._last_s) / max(1, period - 1))
        self._last_s = time_s
        if time_s - self._begin_s >= self._length_s:
            self.next_s = time_s + (period - 1) * self._stretch_s


class _ObservationPass:
    """State of one pass over a video."""

    def __init__(
        self, size_wh: tuple[int, int], silhouettes: SilhouetteCollector | None, settings: ObservationSettings
    ) -> None:
        self._settings = settings
        self._factor = working_factor(size_wh, settings.features)
        self._small_wh = tuple(max(1, n // self._factor) for n in size_wh)
        self._tracker = FeatureTracker(self._factor, settings.features)
        self._edges = EdgeletFinder(size_wh, self._factor, settings.edgelets)
        self._shake = CameraShake(settings.shake)
        self._background = BackgroundImageEstimator(settings.background)
        self._silhouettes = silhouettes
        self._sampled_s = self._tracked_s = -math.inf

    def stretch_period(self) -> int:
        """Return the number of stretches of which one is worked on: 1, 2, 4, ..."""
        tracks, edges = len(self._tracker.tracks), self._edges.count
        return 1 << sum(tracks >= t and edges >= e for t, e in self._settings.sparse_from)

    def update(self, frame: Frame, time_s: float) -> None:
        """Take a frame at a time in seconds."""
        settings = self._settings
        small = frame.small_grey(self._factor)
        if time_s - self._tracked_s > settings.max_gap_frames / settings.track_fps:
            self._tracker.pause()
        self._tracked_s = time_s
        self._tracker.update(small, time_s)
        if time_s - self._sampled_s < settings.interval_tolerance * settings.sample_interval_s:
            return
        moving = self._tracker.moving
        if moving is None:
            return  # right after a gap no motion is known; the next frame is sampled instead
        self._sampled_s = time_s
        self._shake.update(small)
        self._edges.update(frame.grey, moving, time_s)
        self._background.update(frame.image)
        if self._silhouettes is not None:
            rgb = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            self._silhouettes.update(frame.number, time_s, rgb)

    def finish(self) -> NDArray[np.uint8] | None:
        """Finish the tracks; return the background image (H, W, 3) uint8 RGB, None where there is none."""
        self._tracker.pause()
        image = self._background.median_image()
        return None if image is None else np.ascontiguousarray(image[..., ::-1])

    def observations(
        self, source: FrameSource, time_s: float, *, ended: bool, background: NDArray[np.uint8] | None = None
    ) -> Observations:
        """Return what was gathered up to a time in seconds."""
        width = self._small_wh[0]
        return Observations(
            source.size_wh,
            source.fps,
            time_s,
            list(self._tracker.tracks),
            self._edges.edgelets,
            np.array(self._shake.shifts_px) / width,
            self._shake.drift_px / width,
            background,
            ended,
        )
