"""From the detections of one frame after the other to measured vehicles."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections, inside_larger_box
from detector.speed.track_fit import TrackFitter
from detector.speed.track_speed import SPEED_GAP, MeasuredVehicle, TrackPoints, measure_track, road_movement
from detector.tracking.iou_tracker import DUPLICATE, IouTracker, TrackRules
from detector.tracking.per_track import gap_speeds_kmh
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["MeasureRules", "SpeedMeter"]

_TOO_FEW = "too few points"
_STILL, _OFF_COURSE = "stands still", "does not move along the road"
# Number of last steps from frame to frame that give the frame rate.
_STEPS = 200
# Least step between two frames, s, and largest number of a frame.
_MIN_STEP_S, _MAX_TICK = 1e-6, 1e15

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class MeasureRules:
    """Thresholds for points and tracks that count, for frames 1920 px wide.

    Borders, numbers of points and lengths in px are the published ones; jumps and movement in metres are not.

    Source: Kocur & Ftacnik 2020, section 3.5.

    Args:
        border_px: px; a point does not count where an end of its bottom front edge is this close to the border of the
            frame, since the vehicle is probably cut there. (The paper asks this of the middle of the edge.) A wider
            border makes tracks shorter.
        min_points: tracks with fewer points that count are dropped. More points leave out false tracks, and vehicles
            that are seen briefly.
        min_length_px: px; tracks are dropped unless their first and last point are farther apart. It leaves out
            flicker, and vehicles far away.
        jump_m: metres. A track that moves more than `jump_m` plus what `jump_kmh` allows from one point to the next has
            changed from one vehicle to another: boxes of vehicles that are close together merge. The longest part
            between such jumps counts. A smaller value also cuts tracks with inaccurate boxes.
        jump_kmh: km/h, see `jump_m`; higher than any speed on a road.
        min_along_m: metres along the road between the ends of a track. Tracks of parked vehicles, and of what a swaying
            camera shows beside its place, are shorter. A larger value drops vehicles that only move up in a queue.
        min_along_sigmas: the same in multiples of the points' scatter around steady motion, for flicker.
        max_across_share: a track that moves farther across the road than this share of what it moves along it is
            dropped. A larger one keeps what slides off the road, a smaller one drops changes of lane.
        end_points: number of points of which each end of a track is the median.
        low_fps: frames per second below which vehicles may pass between two frames: it is told where most tracks are
            dropped for too few points.
        track: thresholds of the tracker.
    """

    border_px: float = 10.0
    min_points: int = 5
    min_length_px: float = 100.0
    jump_m: float = 5.0
    jump_kmh: float = 300.0
    min_along_m: float = 1.0
    min_along_sigmas: float = 2.0
    max_across_share: float = 0.5
    end_points: int = 5
    low_fps: float = 8.0
    track: TrackRules = field(default_factory=TrackRules)

    @classmethod
    def for_frame(
        cls, frame_wh: tuple[int, int], reference_width_px: int = 1920, min_border_px: float = 6.0
    ) -> MeasureRules:
        """Scale the published distances to the width of a frame.

        Args:
            frame_wh: px; size of the frame.
            reference_width_px: px; width of the frames for which the distances were published.
            min_border_px: px; the border is not scaled below it, since masks do not get finer with the frame.
        """
        share = frame_wh[0] / reference_width_px
        return cls(border_px=max(cls.border_px * share, min_border_px), min_length_px=cls.min_length_px * share)


class SpeedMeter:
    """Track the detections of a camera and measure each vehicle as soon as its track has ended.

    Args:
        camera: with a scale and the size of the frame.
        fps: frames per second, to count missing frames by their times; None takes it from the times.
        rules: thresholds; the published ones for this size of the frame where left out.
        lane_lines: (L, 3) homogeneous lines between the lanes, frame px.
        fitter: for `fitted3d`: lays bodies over the outlines of the tracks.

    Attributes:
        dropped: number of tracks that were dropped, by reason.
        duplicates: number of boxes that were duplicates of a better one, or parts of a larger one.

    Raises:
        CalibrationError: the camera does not know the size of its frame.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        fps: float | None = None,
        rules: MeasureRules | None = None,
        lane_lines: Array | None = None,
        fitter: TrackFitter | None = None,
    ) -> None:
        if camera.image_wh is None:
            raise CalibrationError(f"camera {camera.name or '(unnamed)'}: its frame's size is not known")
        self.rules = rules or MeasureRules.for_frame(camera.image_wh)
        self.dropped: Counter[str] = Counter()
        self.duplicates = 0
        self._camera, self._fps, self._lane_lines, self._fitter = camera, fps, lane_lines, fitter
        self._tracker = IouTracker(self.rules.track)
        self._tracks: dict[int, TrackPoints] = {}
        self._tick, self._last_s = -1, math.nan
        self._steps_s: deque[float] = deque(maxlen=_STEPS)
        self._measured = 0

    def add(self, detections: Detections) -> tuple[IntArray, list[MeasuredVehicle]]:
        """Track the detections of the next frame.

        Args:
            detections: N, of a frame after the last one.

        Returns:
            ids (N,), the track of each detection, -1 for duplicates and parts of larger boxes; and the vehicles whose
            tracks have ended.
        """
        self._tick = max(self._next_tick(detections), self._tick + 1)
        ids = np.full(len(detections), DUPLICATE, dtype=np.int64)
        single = ~inside_larger_box(detections)
        ids[single], ended = self._tracker.update(self._tick, detections.boxes_xyxy[single], detections.scores[single])
        counts = self._counts(detections.contact_points_px, detections.front_edges_px, detections.contact_visible)
        if self._fitter is not None:
            # Where points count is known when the bodies are.
            places = self._camera.road_points(detections.contact_points_px, invalid="nan")
            counts = np.asarray(np.isfinite(places).all(axis=1))
        for i, number in enumerate(ids.tolist()):
            if number == DUPLICATE:
                self.duplicates += 1
                continue
            points = self._tracks.setdefault(number, TrackPoints())
            # Two points at the same time have no speed between them.
            if counts[i] and not (points.times_s and detections.time_s <= points.times_s[-1]):
                points.frames.append(detections.frame)
                points.times_s.append(detections.time_s)
                points.contact_points_px.append(detections.contact_points_px[i])
                points.vertices_px.append(detections.vertices_px[i])
                points.class_ids.append(int(detections.class_ids[i]))
                points.scores.append(float(detections.scores[i]))
                points.contact_visible.append(bool(detections.contact_visible[i]))
                if detections.outlines_px:
                    points.outlines_px.append(detections.outlines_px[i])
        return ids, self._measure(ended)

    def _next_tick(self, detections: Detections) -> int:
        """Return the number of the frame counting those that are missing."""
        time_s, step_s = detections.time_s, detections.time_s - self._last_s
        self._last_s = time_s
        if step_s > 0:
            self._steps_s.append(step_s)
        if not math.isfinite(time_s):
            return detections.frame
        if self._fps is not None:
            return round(min(time_s * self._fps, _MAX_TICK))
        if not step_s > 0:
            return self._tick + 1
        # Steps of nearly nothing beside a long one would be more frames than can be counted.
        return round(min(self._tick + step_s / max(float(np.median(self._steps_s)), _MIN_STEP_S), _MAX_TICK))

    def problems(self) -> list[str]:
        """Return what makes the figures doubtful, one line each."""
        fps = 1 / float(np.median(self._steps_s)) if self._steps_s else math.inf
        too_few = self.dropped[_TOO_FEW]
        if fps >= self.rules.low_fps or too_few <= self._measured:
            return []
        return [
            f"{too_few} tracks have fewer than {self.rules.min_points} points: at {fps:.2g} frames per second vehicles "
            f"are seen too seldom to be followed; use a video of {self.rules.low_fps:g} or more"
        ]

    def finish(self) -> list[MeasuredVehicle]:
        """End all tracks and return their vehicles."""
        return self._measure(self._tracker.finish())

    def speed_so_far(self, track_id: int) -> float:
        """Return the speed, km/h, of a track that has not ended, from its points up to now; NaN with too few points."""
        points = self._tracks.get(track_id)
        if points is None or len(points.times_s) <= SPEED_GAP:
            return float("nan")
        places = points.on_road_m(self._camera)
        return float(gap_speeds_kmh(places, np.array(points.times_s), np.array([0, len(places)]), SPEED_GAP)[0])

    def _counts(self, points_px: Array, edges_px: Array, visible: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (N,) whether the point counts: its contact with the road is inside the frame and on the road."""
        low, high = self.rules.border_px, np.asarray(self._camera.image_wh) - self.rules.border_px
        inside = ((edges_px > low) & (edges_px < high)).all(axis=(1, 2))
        on_road = np.isfinite(self._camera.road_points(points_px, invalid="nan")).all(axis=1)
        return np.asarray(inside & visible & on_road)

    def _measure(self, ended: list[int]) -> list[MeasuredVehicle]:
        vehicles = []
        for number in ended:
            points = self._fitted(self._without_jumps(self._tracks.pop(number)))
            reason = self._drop_reason(points)
            if reason:
                self.dropped[reason] += 1
            else:
                self._measured += 1
                vehicles.append(measure_track(number, points, self._camera, self._lane_lines))
        return vehicles

    def _fitted(self, points: TrackPoints) -> TrackPoints:
        """Return a track with the points of its body where bodies are fitted, those that count."""
        if self._fitter is None or len(points.frames) < self.rules.min_points:
            return points
        points = self._fitter.fit(points)
        if not points.frames:
            return points
        edges = np.array(points.vertices_px)[:, 4:6]
        visible = np.ones(len(edges), dtype=np.bool_)
        return points.take(np.flatnonzero(self._counts(np.array(points.contact_points_px), edges, visible)))

    def _without_jumps(self, points: TrackPoints) -> TrackPoints:
        """Return the longest part of a track between two jumps."""
        if len(points.times_s) < 2:
            return points
        steps_m = np.hypot(*np.diff(points.on_road_m(self._camera), axis=0).T)
        allowed_m = self.rules.jump_m + self.rules.jump_kmh / 3.6 * np.diff(points.times_s)
        jumps = np.flatnonzero(steps_m > allowed_m) + 1
        ends = np.array([0, *jumps, len(points.times_s)])
        longest = int(np.diff(ends).argmax())
        return points.part(int(ends[longest]), int(ends[longest + 1]))

    def _drop_reason(self, points: TrackPoints) -> str:
        """Return why a track is dropped; empty for a track that counts."""
        if len(points.frames) < self.rules.min_points:
            return _TOO_FEW
        along_m, across_m, scatter_m = road_movement(
            points.on_road_m(self._camera), np.array(points.times_s), self.rules.end_points
        )
        if along_m < max(self.rules.min_along_m, self.rules.min_along_sigmas * scatter_m):
            return _STILL
        if across_m > self.rules.max_across_share * along_m:
            return _OFF_COURSE
        length = float(np.linalg.norm(points.contact_points_px[-1] - points.contact_points_px[0]))
        return "" if length > self.rules.min_length_px else "too short"
