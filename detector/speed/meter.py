"""From tracked detections to vehicles with a speed, a size, a lane and a direction.

A vehicle's speed is the median of the speeds between its points i and i + 5 (the public evaluation protocol), with
the frames' own time stamps. Its uncertainty is the standard error of that median, from the spread of the same speeds:
1.2533 * 1.4826 * MAD / sqrt(number of gaps that share no points). It suits errors that wander slowly along the track,
as those of boxes do, and is too careful where each point errs on its own. It knows nothing of the calibration's error.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections
from detector.tracking.iou_tracker import DUPLICATE, IouTracker, TrackRules
from detector.tracking.per_track import gap_speeds_kmh
from labelgen.geometry import Camera, cuboid_sizes
from labelgen.geometry.homography import Array
from labelgen.geometry.lanes import lanes_of

__all__ = ["MeasureRules", "MeasuredVehicle", "SpeedMeter", "inside_larger_box", "speed_and_error"]

IntArray = NDArray[np.int64]
_FULL_HD_WIDTH = 1920
_LEAST_BORDER_PX = 6.0
GAP = 5
# Standard error of a normal sample's median, in standard deviations over sqrt(n), and the latter from the MAD.
_MEDIAN_ERROR, _MAD_TO_SIGMA = 1.2533, 1.4826


@dataclass(frozen=True)
class MeasureRules:
    """Which points and tracks count; the defaults are the published ones, for frames 1920 px wide, but for the leaps.

    Args:
        border_px: points whose bottom front edge comes this close to the frame's border do not count: there the
            vehicle is likely to be cut. (Published for the edge's middle; both its ends are asked here.)
        min_points: tracks with fewer points that count are dropped.
        min_length_px: tracks are dropped unless their first and last point lie farther apart.
        leap_m, leap_kmh: a track that moves farther between two points than the one and what the other allows in that
            time has passed from one vehicle to another: boxes of vehicles close behind each other merge. Its longest
            part counts. Ours.
        track: parameters of the tracker.
    """

    border_px: float = 10.0
    min_points: int = 5
    min_length_px: float = 100.0
    leap_m: float = 5.0
    leap_kmh: float = 300.0
    track: TrackRules = field(default_factory=TrackRules)

    @classmethod
    def for_frame(cls, frame_wh: tuple[int, int]) -> MeasureRules:
        """The published rules for frames of any size: distances scale with the frame's width.

        The border does not go below 6 px, though: masks do not get finer with the frame.
        """
        share = frame_wh[0] / _FULL_HD_WIDTH
        return cls(border_px=max(10.0 * share, _LEAST_BORDER_PX), min_length_px=100.0 * share)


@dataclass(frozen=True, eq=False)
class MeasuredVehicle:
    """One vehicle that has passed; K points that count.

    Args:
        track_id: number of its track.
        frames: (K,) frame numbers.
        times_s: (K,) seconds, rising.
        points_px: (K, 2) frame px, measured points.
        speed_kmh: median over 5-point gaps; NaN with 5 points or fewer.
        uncertainty_kmh: standard error of the speed; NaN likewise.
        size_lwh_m: (3,) metres, medians over the 3D boxes; NaN for variants without.
        direction: "away" from the camera or "towards" it.
        lane: number between the scene's lane lines; None where not known or outside.
        class_id: most frequent `labelgen.labels.VehicleClass`.
        score: mean score.
    """

    track_id: int
    frames: IntArray
    times_s: Array
    points_px: Array
    speed_kmh: float
    uncertainty_kmh: float
    size_lwh_m: Array
    direction: str
    lane: int | None
    class_id: int
    score: float

    def to_car(self) -> dict[str, Any]:
        """A car of the public result format, with its times beside its frame numbers."""
        return {
            "id": self.track_id,
            "frames": self.frames.tolist(),
            "posX": np.round(self.points_px[:, 0], 4).tolist(),
            "posY": np.round(self.points_px[:, 1], 4).tolist(),
            "times": np.round(self.times_s, 6).tolist(),
        }


@dataclass
class _Points:
    """What is kept of a track while it goes on."""

    frames: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    contact_points_px: list[Array] = field(default_factory=list)
    vertices_px: list[Array] = field(default_factory=list)
    class_ids: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)

    def part(self, start: int, stop: int) -> _Points:
        """The points from one to before another."""
        return _Points(*(getattr(self, f.name)[start:stop] for f in fields(self)))


def speed_and_error(points_m: Array, times_s: Array) -> tuple[float, float]:
    """Speed of one track and its standard error, km/h.

    Args:
        points_m: (K, 2) metres on the road.
        times_s: (K,) seconds, rising.

    Returns:
        NaN, NaN with 5 points or fewer.
    """
    count = len(times_s) - GAP
    if count < 1:
        return float("nan"), float("nan")
    speed = float(gap_speeds_kmh(points_m, times_s, np.array([0, len(times_s)]), GAP)[0])
    # Each gap as a track of its own, so that the one formula gives every gap's speed.
    rows = np.arange(count)[:, None] + np.arange(GAP + 1)
    gaps = gap_speeds_kmh(points_m[rows].reshape(-1, 2), times_s[rows].ravel(), np.arange(count + 1) * (GAP + 1), GAP)
    spread = float(np.median(np.abs(gaps - speed))) * _MAD_TO_SIGMA
    return speed, _MEDIAN_ERROR * spread / float(np.sqrt(max(1.0, count / GAP)))


def _measure(track_id: int, points: _Points, camera: Camera, lane_lines: Array | None) -> MeasuredVehicle:
    """Measure a finished track."""
    feet, times = np.array(points.contact_points_px), np.array(points.times_s)
    ground = camera.road_points(feet, invalid="nan")
    speed, error = speed_and_error(ground, times)
    sizes = cuboid_sizes(np.array(points.vertices_px), camera)
    known = np.isfinite(sizes).all(axis=1)
    lane = None
    if lane_lines is not None:
        lanes = Counter(lanes_of(feet, lane_lines).tolist())
        lane = lanes.most_common(1)[0][0]
    return MeasuredVehicle(
        track_id=track_id,
        frames=np.array(points.frames, dtype=np.int64),
        times_s=times,
        points_px=feet,
        speed_kmh=speed,
        uncertainty_kmh=error,
        size_lwh_m=np.median(sizes[known], axis=0) if known.any() else np.full(3, np.nan),
        direction="away" if ground[-1, 0] > ground[0, 0] else "towards",
        lane=None if lane is None or lane < 0 else lane,
        class_id=Counter(points.class_ids).most_common(1)[0][0],
        score=float(np.mean(points.scores)),
    )


class SpeedMeter:
    """Detections in, frame by frame; vehicles out, as soon as their tracks have ended.

    Args:
        camera: with a scale and the frame's size.
        fps: frames per second, to count frames left out by their time stamps; None counts by frame numbers.
        rules: which points and tracks count; the published ones for this frame size where left out.
        lane_lines: (L, 3) homogeneous px lines between the lanes.

    Attributes:
        dropped: how many tracks were no vehicles, by reason.
        duplicates: how many boxes repeated a better one, or were parts of a larger one.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        fps: float | None = None,
        rules: MeasureRules | None = None,
        lane_lines: Array | None = None,
    ) -> None:
        assert camera.image_wh is not None
        self.rules = rules or MeasureRules.for_frame(camera.image_wh)
        self.dropped: Counter[str] = Counter()
        self.duplicates = 0
        self._camera, self._fps, self._lane_lines = camera, fps, lane_lines
        self._tracker = IouTracker(self.rules.track)
        self._tracks: dict[int, _Points] = {}
        self._tick = -1

    def add(self, found: Detections) -> tuple[IntArray, list[MeasuredVehicle]]:
        """Take in one frame's detections.

        Returns:
            ids (N,), the track of each detection, -1 for duplicates and fragments; and the vehicles whose tracks
            have ended.
        """
        tick = found.frame
        if self._fps is not None and np.isfinite(found.time_s):
            tick = round(found.time_s * self._fps)
        self._tick = max(tick, self._tick + 1)
        ids = np.full(len(found), DUPLICATE, dtype=np.int64)
        own = ~inside_larger_box(found)
        ids[own], ended = self._tracker.update(self._tick, found.boxes_xyxy[own], found.scores[own])
        counts = self._counts(found)
        for i, number in enumerate(ids.tolist()):
            if number == DUPLICATE:
                self.duplicates += 1
                continue
            points = self._tracks.setdefault(number, _Points())
            # Without time between them two points have no speed.
            if counts[i] and not (points.times_s and found.time_s <= points.times_s[-1]):
                points.frames.append(found.frame)
                points.times_s.append(found.time_s)
                points.contact_points_px.append(found.contact_points_px[i])
                points.vertices_px.append(found.vertices_px[i])
                points.class_ids.append(int(found.class_ids[i]))
                points.scores.append(float(found.scores[i]))
        return ids, self._measured(ended)

    def finish(self) -> list[MeasuredVehicle]:
        """End all tracks."""
        return self._measured(self._tracker.finish())

    def speed_so_far(self, track_id: int) -> float:
        """km/h of a track that still goes on, from its points up to now; NaN while there are too few."""
        points = self._tracks.get(track_id)
        if points is None or len(points.times_s) <= GAP:
            return float("nan")
        ground = self._camera.road_points(np.array(points.contact_points_px), invalid="nan")
        offsets = np.array([0, len(ground)])
        return float(gap_speeds_kmh(ground, np.array(points.times_s), offsets, GAP)[0])

    def _counts(self, found: Detections) -> NDArray[np.bool_]:
        """(N,) whose points count: the foot is inside the picture and on the road."""
        low, high = self.rules.border_px, np.asarray(self._camera.image_wh) - self.rules.border_px
        inside = ((found.front_edges_px > low) & (found.front_edges_px < high)).all(axis=(1, 2))
        on_road = np.isfinite(self._camera.road_points(found.contact_points_px, invalid="nan")).all(axis=1)
        return np.asarray(inside & found.contact_visible & on_road)

    def _measured(self, ended: list[int]) -> list[MeasuredVehicle]:
        vehicles = []
        for number in ended:
            points = self._without_leaps(self._tracks.pop(number))
            reason = self._too_short(points)
            if reason:
                self.dropped[reason] += 1
            else:
                vehicles.append(_measure(number, points, self._camera, self._lane_lines))
        return vehicles

    def _without_leaps(self, points: _Points) -> _Points:
        """The longest part in which the vehicle drives."""
        if len(points.times_s) < 2:
            return points
        ground = self._camera.road_points(np.array(points.contact_points_px), invalid="nan")
        way = np.hypot(*np.diff(ground, axis=0).T)
        leaps = np.flatnonzero(way > self.rules.leap_m + self.rules.leap_kmh / 3.6 * np.diff(points.times_s)) + 1
        ends = np.array([0, *leaps, len(points.times_s)])
        longest = int(np.diff(ends).argmax())
        return points.part(int(ends[longest]), int(ends[longest + 1]))

    def _too_short(self, points: _Points) -> str:
        if len(points.frames) < self.rules.min_points:
            return "too few points"
        reach = float(np.linalg.norm(points.contact_points_px[-1] - points.contact_points_px[0]))
        return "" if reach > self.rules.min_length_px else "too short"


def inside_larger_box(found: Detections) -> NDArray[np.bool_]:
    """(N,) which detections stand where a larger one stands: no two vehicles share a piece of road.

    A detection counts as a fragment where its measured point lies on the floor of the 3D box of another one whose 2D
    box is larger. Without 3D boxes there are no floors, and no fragments.
    """
    floors = found.vertices_px[:, 4:]
    starts, ends = floors[None], np.roll(floors, -1, axis=1)[None]
    ahead, to_point = ends - starts, found.contact_points_px[:, None, None] - starts
    side = ahead[..., 0] * to_point[..., 1] - ahead[..., 1] * to_point[..., 0]
    with np.errstate(invalid="ignore"):
        inside = (side > 0).all(axis=2) | (side < 0).all(axis=2)
    areas = _areas(found.boxes_xyxy)
    return np.asarray((inside & (areas[:, None] < areas[None])).any(axis=1))


def _areas(boxes: Array) -> Array:
    out: Array = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return out
