"""The measurement of one vehicle from the points of its finished track: speed, size, lane and direction.

The speed is the median of the speeds between points i and i + 5, with the time stamps of the frames (Sochor et al.,
IEEE T-ITS 2018, public evaluation script). Its uncertainty is the standard error of that median, from the spread of the
same speeds:

    1.2533 * 1.4826 * MAD / sqrt(number of gaps that share no points)

It fits errors that vary slowly along the track, as those of boxes do. It is too large where the errors of the points
are independent. Points of fitted bodies (`fitted3d`) err together; what that adds follows from the fit's own standard
deviations. The error of the calibration is not part of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.tracking.per_track import gap_speeds_kmh
from labelgen.geometry import Camera, cuboid_sizes
from labelgen.geometry.homography import Array
from labelgen.geometry.lanes import lanes_of

__all__ = ["SPEED_GAP", "MeasuredVehicle", "TrackPoints", "measure_track", "median_speed_and_error", "road_movement"]

SPEED_GAP = 5
"""Points between both ends of one speed measurement; the public protocol fixes it."""
# For normally distributed values: the standard error of the median is 1.2533 standard deviations over sqrt(n), and the
# standard deviation is 1.4826 times the median absolute deviation (MAD).
_MEDIAN_ERROR, _MAD_TO_SIGMA = 1.2533, 1.4826


@dataclass(frozen=True, eq=False)
class MeasuredVehicle:
    """One vehicle that has passed, with K points that count.

    Args:
        track_id: number of its track.
        frames: (K,) frame numbers.
        times_s: (K,) seconds, rising.
        points_px: (K, 2) frame px, contact points.
        speed_kmh: median over gaps of 5 points; NaN with 5 points or fewer.
        uncertainty_kmh: standard error of the speed; NaN likewise.
        size_lwh_m: (3,) metres, medians over the 3D boxes; NaN for variants without.
        direction: "away" from the camera or "towards" it.
        lane: number between the lane lines of the scene; None where not known or outside.
        class_id: most frequent `labelgen.labels.VehicleClass`.
        score: mean score.
    """

    track_id: int
    frames: NDArray[np.int64]
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
        """Return a car of the public result format, with its times next to its frame numbers."""
        return {
            "id": self.track_id,
            "frames": self.frames.tolist(),
            "posX": np.round(self.points_px[:, 0], 4).tolist(),
            "posY": np.round(self.points_px[:, 1], 4).tolist(),
            "times": np.round(self.times_s, 6).tolist(),
        }


@dataclass
class TrackPoints:
    """The points of a track that count; all lists have one entry per point, the last two only for `fitted3d`."""

    frames: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    contact_points_px: list[Array] = field(default_factory=list)
    vertices_px: list[Array] = field(default_factory=list)
    class_ids: list[int] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    contact_visible: list[bool] = field(default_factory=list)
    outlines_px: list[Array] = field(default_factory=list)
    along_sd_m: list[float] = field(default_factory=list)

    def part(self, start: int, stop: int) -> TrackPoints:
        """Return the points start to stop - 1."""
        return self.take(range(start, stop))

    def take(self, rows: Iterable[int]) -> TrackPoints:
        """Return some of the points, by number."""
        numbers = [int(row) for row in rows]
        lists = (getattr(self, f.name) for f in fields(self))
        return TrackPoints(*([values[n] for n in numbers] if values else [] for values in lists))

    def on_road_m(self, camera: Camera) -> Array:
        """Return (K, 2) metres, the contact points on the road."""
        return camera.road_points(np.array(self.contact_points_px), invalid="nan")


def median_speed_and_error(points_m: Array, times_s: Array) -> tuple[float, float]:
    """Return the speed of one track and its standard error, km/h.

    Args:
        points_m: (K, 2) metres on the road.
        times_s: (K,) seconds, rising.

    Returns:
        speed and standard error; NaN, NaN with 5 points or fewer.
    """
    count = len(times_s) - SPEED_GAP
    if count < 1:
        return float("nan"), float("nan")
    speed = float(gap_speeds_kmh(points_m, times_s, np.array([0, len(times_s)]), SPEED_GAP)[0])
    # Each gap as a track of its own, so that the same formula gives the speed of every gap.
    rows = np.arange(count)[:, None] + np.arange(SPEED_GAP + 1)
    offsets = np.arange(count + 1) * (SPEED_GAP + 1)
    gaps = gap_speeds_kmh(points_m[rows].reshape(-1, 2), times_s[rows].ravel(), offsets, SPEED_GAP)
    sigma = float(np.median(np.abs(gaps - speed))) * _MAD_TO_SIGMA
    return speed, _MEDIAN_ERROR * sigma / float(np.sqrt(max(1.0, count / SPEED_GAP)))


def road_movement(points_m: Array, times_s: Array, end_points: int) -> tuple[float, float, float]:
    """Return how far a track moves along and across the road, and how its points scatter along it, all in metres.

    Args:
        points_m: (K, 2) metres along and across the road, at least 2.
        times_s: (K,) seconds, rising.
        end_points: number of points of which each end is the median; fewer in short tracks.

    Returns:
        distances between the ends along and across the road; standard deviation along it around steady motion.
    """
    count = min(max(1, len(points_m) // 3), end_points)
    along, across = np.abs(np.median(points_m[-count:], axis=0) - np.median(points_m[:count], axis=0)).tolist()
    times = times_s - times_s.mean()
    offsets = points_m[:, 0] - points_m[:, 0].mean()
    scatter = float(np.std(offsets - times * (times @ offsets) / (times @ times)))
    return along, across, scatter


def _common_share(along_m: Array, sd_m: Array) -> float:
    """Return how far, as a share of the distance driven, the places of a fitted body err together.

    They err alike, since they share a size and a form, but more in the distance: what they err by stretches the way.
    """
    off = along_m - along_m.mean()
    return float(abs(off @ sd_m) / max(float(off @ off), 1e-9))


def measure_track(track_id: int, points: TrackPoints, camera: Camera, lane_lines: Array | None) -> MeasuredVehicle:
    """Measure the vehicle of a finished track.

    Args:
        track_id: number of the track.
        points: at least one.
        camera: with a scale.
        lane_lines: (L, 3) homogeneous lines between the lanes, frame px; None where not known.
    """
    places = points.on_road_m(camera)
    contact, times = np.array(points.contact_points_px), np.array(points.times_s)
    speed, error = median_speed_and_error(places, times)
    if points.along_sd_m:
        error = float(np.hypot(error, speed * _common_share(places[:, 0], np.array(points.along_sd_m))))
    sizes = cuboid_sizes(np.array(points.vertices_px), camera)
    known = np.isfinite(sizes).all(axis=1)
    lane = None
    if lane_lines is not None:
        lane = Counter(lanes_of(contact, lane_lines).tolist()).most_common(1)[0][0]
    return MeasuredVehicle(
        track_id=track_id,
        frames=np.array(points.frames, dtype=np.int64),
        times_s=times,
        points_px=contact,
        speed_kmh=speed,
        uncertainty_kmh=error,
        size_lwh_m=np.median(sizes[known], axis=0) if known.any() else np.full(3, np.nan),
        direction="away" if places[-1, 0] > places[0, 0] else "towards",
        lane=None if lane is None or lane < 0 else lane,
        class_id=Counter(points.class_ids).most_common(1)[0][0],
        score=float(np.mean(points.scores)),
    )
