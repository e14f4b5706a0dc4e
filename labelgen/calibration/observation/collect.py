"""One pass over a video: everything that calibration needs is gathered while the frames go by, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.background_image import Backdrop
from labelgen.calibration.observation.edgelets import EdgeletFinder
from labelgen.calibration.observation.klt_tracks import CameraShake, FeatureTracker, Track, working_factor
from labelgen.errors import DataError
from labelgen.geometry.homography import Array
from labelgen.media.frames import Frame, FrameSource
from labelgen.progress import progress_bar

__all__ = ["Collector", "Observations", "Track", "observe"]

_TRACK_FPS = 15.0
_ASSUMED_FPS = 25.0
# Two or three looks per second: enough for edges and silhouettes, since vehicles look much the same a frame later.
_LOOK_S = 0.4
# Once so many tracks and edges are there, only every other stretch of this many seconds is worked on, and then every
# fourth: more of the same traffic tells little, and other traffic tells more.
_STRETCH_S = 3.0
_PLENTY = ((250, 2000), (1000, 8000))
_FIRST_CHECK_S = 30.0


class Collector(Protocol):
    """Something that rides on the pass over the video.

    `see` is called in order of time, a few times per second of video, with the frame (H, W, 3) RGB at full size.
    """

    def see(self, number: int, time_s: float, rgb: NDArray[np.uint8]) -> None: ...


@dataclass(frozen=True, eq=False)
class Observations:
    """What one pass over a video gave.

    Args:
        size_wh: px of the frames.
        fps: frame rate; None where the source states none.
        duration_s: how much of the video was looked at.
        tracks: features on moving things, in order of their end.
        edgelets: (N, 5) straight edges on moving things: x0, y0, x1, y1 in px, and time, s.
        shifts: (L,) share of the picture's width by which most of the scene had shifted within a few seconds, per look.
        drift: by how much of the picture's width the camera drifted in all.
        background: (H, W, 3) uint8 RGB, the empty road, full size; None where it could not be learnt.
        ended: whether the video was seen to its end (or to the duration asked for), not stopped early.
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
    collectors: Sequence[Collector] = (),
    enough: Callable[[Observations], bool] | None = None,
) -> Observations:
    """Look through a video once.

    Args:
        source: the frames.
        duration_s: look at so much of its beginning; None for all of it.
        collectors: what else wants to see the frames.
        enough: asked now and then, ever more rarely, whether what was gathered is enough.

    Raises:
        DataError: no frame came.
    """
    watch = _Watch(source.size_wh, collectors)
    fps = source.fps or _ASSUMED_FPS
    count = source.frame_count
    if duration_s is not None:
        count = min(count or 2**31, math.ceil(duration_s * fps))
    step = max(1, round(fps / _TRACK_FPS))
    done, time_s, check_s, ended = 0, 0.0, _FIRST_CHECK_S, True
    with progress_bar(count, "frame", "watching") as advance:
        turns = _Turns()
        wanted = source.frames(lambda n: n % step == 0 and n / fps >= turns.next_s, lambda: turns.next_s)
        for frame in wanted:
            time_s = frame.time_s if math.isfinite(frame.time_s) else frame.number / fps
            if duration_s is not None and time_s >= duration_s:
                break
            turns.worked(time_s, watch.pace())
            watch.take(frame, time_s)
            advance(frame.number + 1 - done)
            done = frame.number + 1
            if enough is not None and time_s >= check_s:
                check_s *= 1.6
                if enough(watch.observations(source, time_s, ended=False)):
                    ended = False
                    break
    if not done:
        raise DataError(f"{source.path}: no frame could be read; is it a video?")
    picture = watch.finish()
    return watch.observations(source, time_s, ended=ended, picture=picture)


class _Turns:
    """Which stretches of a video are worked on: a share of it.

    Attributes:
        next_s: nothing before is to be worked on.
    """

    def __init__(self) -> None:
        self.next_s = self._begin_s = self._last_s = 0.0
        self._length_s = _STRETCH_S

    def worked(self, time_s: float, pace: int) -> None:
        """A frame is worked on; one of so many stretches shall be."""
        if time_s > self._last_s + _STRETCH_S / 2:
            # A leap may be longer than was asked for, and what is worked on then as well.
            self._begin_s = time_s
            self._length_s = max(_STRETCH_S, (time_s - self._last_s) / max(1, pace - 1))
        self._last_s = time_s
        if time_s - self._begin_s >= self._length_s:
            self.next_s = time_s + (pace - 1) * _STRETCH_S


class _Watch:
    """The state of a pass."""

    def __init__(self, size_wh: tuple[int, int], collectors: Sequence[Collector]) -> None:
        self._factor = working_factor(size_wh)
        self._small_wh = tuple(max(1, n // self._factor) for n in size_wh)
        self._tracker = FeatureTracker(self._factor)
        self._edges = EdgeletFinder(size_wh, self._factor)
        self._shake = CameraShake()
        self._backdrop = Backdrop()
        self._collectors = collectors
        self._looked_s = self._taken_s = -math.inf

    def pace(self) -> int:
        """One of how many stretches of the video is worked on."""
        tracks, edges = len(self._tracker.tracks), self._edges.count
        return 1 << sum(tracks >= t and edges >= e for t, e in _PLENTY)

    def take(self, frame: Frame, time_s: float) -> None:
        small = frame.small_grey(self._factor)
        if time_s - self._taken_s > 2.5 / _TRACK_FPS:
            self._tracker.pause()
        self._taken_s = time_s
        self._tracker.see(small, time_s)
        if time_s - self._looked_s < 0.9 * _LOOK_S:
            return
        moving = self._tracker.moving
        if moving is None:
            return  # right after a pause nothing is known to move yet: the next frame will do
        self._looked_s = time_s
        self._shake.see(small)
        self._edges.see(frame.grey, moving, time_s)
        self._backdrop.look(frame.image)
        if self._collectors:
            rgb = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
            for collector in self._collectors:
                collector.see(frame.number, time_s, rgb)

    def finish(self) -> NDArray[np.uint8] | None:
        """At the end: what is still on its way, and the picture of the empty scene, RGB."""
        self._tracker.pause()
        picture = self._backdrop.picture()
        return None if picture is None else np.ascontiguousarray(picture[..., ::-1])

    def observations(
        self, source: FrameSource, time_s: float, *, ended: bool, picture: NDArray[np.uint8] | None = None
    ) -> Observations:
        width = self._small_wh[0]
        return Observations(
            source.size_wh,
            source.fps,
            time_s,
            list(self._tracker.tracks),
            self._edges.edgelets,
            np.array(self._shake.shifts_px) / width,
            self._shake.drift_px / width,
            picture,
            ended,
        )
