"""The public BrnoCompSpeed evaluation protocol (median mode), over all tracks of a recording at once.

Source: Sochor et al., "Comprehensive Data Set for Automatic Single Camera Visual Speed Measurement", IEEE T-ITS 2018,
and its public evaluation script. This module returns the numbers of that script.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.tracking.per_track import gap_speeds_kmh, nearest_rows
from detector.tracking.tracks import Tracks
from labelgen.datasets.brnocompspeed import GroundTruth
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array, IntArray, translation
from labelgen.geometry.lanes import between_lines, lanes_of, line_values

__all__ = ["Crossings", "RecordingScore", "ScoringRules", "line_crossings", "prefilter", "score_recording"]


@dataclass(frozen=True)
class ScoringRules:
    """Constants of the public evaluation script. Scores with other values cannot be compared with published ones.

    Args:
        frame_wh: px; size of the recordings' frames.
        border_px: px; points this close to the border of the frame are left out, because boxes are cut there.
        fit_points: points, the nearest to a measurement line, that the crossing of this line is fitted to; tracks with
            fewer points, or fewer of them between the first and the last line, are left out.
        match_window_s: seconds; a track is matched to a ground-truth car if it crosses the last line within this time
            of the car. A wider window finds more cars, and mistakes neighbours for each other.
    """

    frame_wh: tuple[int, int] = (1920, 1080)
    border_px: int = 10
    fit_points: int = 6
    match_window_s: float = 0.2


_RULES = ScoringRules()


@dataclass(frozen=True, eq=False)
class RecordingScore:
    """Score of one system on one recording, with G ground-truth cars and S surveyed segments.

    Args:
        truth_kmh: (G,) true speeds.
        valid: (G,) whether the data set counts the ground-truth car.
        matched: (G,) whether a track is matched to the car.
        counted: (G,) whether the speed error of the car counts; all of these cars are matched and valid.
        speeds_kmh: (G,) measured speed of the matched track; NaN where there is none.
        false_positives: number of tracks without a ground-truth car, `intersection_failures` among them.
        intersection_failures: number of tracks whose crossings or speed could not be determined.
        ratio_errors: (S (S - 1) / 2,) |image ratio - true ratio| over all pairs of surveyed segments.
        ratio_errors_relative: the same in percent of the true ratio.
        distance_errors_m: (S,) |measured - true| length of the surveyed segments.
        distance_errors_relative: the same in percent.
        tracks_read: number of cars in the result file.
        dropped: number of cars that the protocol leaves out, by reason.
    """

    truth_kmh: Array
    valid: NDArray[np.bool_]
    matched: NDArray[np.bool_]
    counted: NDArray[np.bool_]
    speeds_kmh: Array
    false_positives: int
    intersection_failures: int
    ratio_errors: Array
    ratio_errors_relative: Array
    distance_errors_m: Array
    distance_errors_relative: Array
    tracks_read: int
    dropped: dict[str, int]


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where and when N tracks cross a line.

    Args:
        points_px: (N, 2) frame px; NaN or infinite where a track does not cross the line.
        frames: (N,) frame numbers, with fractions; NaN or infinite likewise.
    """

    points_px: Array
    frames: Array

    @property
    def finite(self) -> NDArray[np.bool_]:
        """(N,) whether both place and time are known."""
        return np.isfinite(self.points_px).all(axis=1) & np.isfinite(self.frames)


def _inside_frame(points_px: Array) -> NDArray[np.bool_]:
    inside = (points_px > _RULES.border_px) & (points_px < np.array(_RULES.frame_wh) - _RULES.border_px)
    return inside[:, 0] & inside[:, 1]


def prefilter(tracks: Tracks, truth: GroundTruth) -> Tracks:
    """Return the tracks that the protocol counts, without their points near the border of the frame.

    Tracks that are left out are counted in `Tracks.dropped`, by reason.

    Args:
        tracks: as read from the result file.
        truth: ground truth of the recording.
    """
    if not len(tracks):
        return tracks
    first_s = tracks.frames[tracks.offsets[:-1]] / truth.fps
    tracks = tracks.keep_tracks(first_s < truth.last_times_s.max(), "after the ground truth")
    tracks = tracks.keep_points(_inside_frame(tracks.points_px))
    tracks = tracks.keep_tracks(tracks.lengths >= _RULES.fit_points, "too few points")

    lane = lanes_of(tracks.points_px, truth.lane_lines)
    tracks = tracks.keep_tracks(tracks.count(lane < 0) == 0, "outside the lanes")
    if truth.invalid_lanes:
        lane = lanes_of(tracks.points_px, truth.lane_lines)
        tracks = tracks.keep_tracks(tracks.count(np.isin(lane, list(truth.invalid_lanes))) == 0, "in an invalid lane")

    ends = truth.measurement_lines[[0, -1]]
    values = line_values(tracks.points_px, ends)
    measured = tracks.count(between_lines(values[:, 0], values[:, 1], ends[0], ends[1]))
    return tracks.keep_tracks(measured >= _RULES.fit_points, "not between the measurement lines")


def _fit(x: Array, y: Array) -> tuple[Array, Array]:
    """Fit lines y = slope x + intercept by least squares along the last axis; NaN where all x are the same."""
    centre_x, centre_y = x.mean(axis=-1), y.mean(axis=-1)
    dx, dy = x - centre_x[..., None], y - centre_y[..., None]
    spread = np.where(np.ptp(x, axis=-1) > 0, (dx * dx).sum(axis=-1), np.nan)
    slope = (dx * dy).sum(axis=-1) / spread
    return slope, centre_y - slope * centre_x


def line_crossings(tracks: Tracks, line: Array) -> Crossings:
    """Return where and when tracks cross a line, from their six points nearest to it.

    A line is fitted to these points, and their frame number is fitted over their distance along that line.

    Args:
        tracks: N tracks of at least 6 points each.
        line: (3,) homogeneous line in frame px.
    """
    distances = np.abs(line_values(tracks.points_px, line[None])[:, 0]) / np.linalg.norm(line[:2])
    rows = nearest_rows(distances, tracks.offsets, _RULES.fit_points)
    x, y = tracks.points_px[rows, 0], tracks.points_px[rows, 1]
    slope, intercept = _fit(x, y)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        scale = slope * line[1] + line[0]
        place = np.stack([-line[2] - intercept * line[1], intercept * line[0] - slope * line[2]]) / scale
        # The protocol measures along the fitted line, unsigned, from where that line meets y = 0.
        start, length = -intercept / slope, np.hypot(1.0, slope)
        along = np.abs(x - start[:, None] + slope[:, None] * y) / length[:, None]
        rate, offset = _fit(along, tracks.frames[rows])
        frames = rate * np.hypot(place[0] - start, place[1]) + offset
    return Crossings(place.T, frames)


def _road_matrix(camera: Camera) -> Array:
    """Return the (3, 3) homography from frame px to metres on the road.

    `Camera.road_points` refuses pixels beyond the horizon. The protocol maps them to a point behind the camera, and
    a bad calibration has to be scored by the same rules.
    """
    height = camera.height_m
    rays = camera.axes @ np.diag([1.0, 1.0, camera.focal]) @ translation(*-camera.pp)
    return np.diag([height, height, -1.0]) @ rays


def _road_points(camera: Camera, points_px: Array) -> Array:
    """Return (P, 2) metres on the road. A matrix product would start threads in NumPy, which is slower here."""
    mapped = line_values(points_px, _road_matrix(camera))
    with np.errstate(divide="ignore", invalid="ignore"):
        metres: Array = mapped[:, :2] / mapped[:, 2:]
    return metres


def _match(truth: GroundTruth, times_s: Array, lanes: IntArray) -> IntArray:
    """Match each ground-truth car with the track in its lanes whose last crossing is nearest in time.

    Args:
        truth: G cars.
        times_s: (N,) seconds at which the tracks cross the last line.
        lanes: (N,) lane of each track there.

    Returns:
        (G,) number of the track; -1 for none. Two cars may have the same track.
    """
    best = np.full(len(truth), -1)
    best_gap = np.full(len(truth), np.inf)
    for lane in range(truth.in_lane.shape[1]):
        in_lane = np.flatnonzero(lanes == lane)
        if not len(in_lane):
            continue
        # Of tracks with the same time, the first in the file counts.
        times, first = np.unique(times_s[in_lane], return_index=True)
        after = np.searchsorted(times, truth.last_times_s)
        for neighbour in (after - 1, after):
            track = in_lane[first[neighbour.clip(0, len(times) - 1)]]
            gap = np.abs(times_s[track] - truth.last_times_s)
            closer = (gap < best_gap) | ((gap == best_gap) & (track < best))
            closer &= truth.in_lane[:, lane]
            best = np.where(closer, track, best)
            best_gap = np.where(closer, gap, best_gap)
    return np.where(best_gap < _RULES.match_window_s, best, -1)


def _count_unmatched(truth: GroundTruth, times_s: Array, ids: list[Hashable], match: IntArray) -> int:
    """Count the tracks within the time of the ground truth whose name is the name of no matched track."""
    matched_ids = {ids[track] for track in match[match >= 0]}
    matched = np.array([name in matched_ids for name in ids], dtype=np.bool_)
    times = truth.last_times_s
    return int(np.count_nonzero((times_s >= times.min()) & (times_s < times.max()) & ~matched))


def _calibration_errors(truth: GroundTruth, camera: Camera) -> tuple[Array, Array, Array, Array]:
    """Return the errors of ratios, absolute and in percent, and of lengths, in metres and in percent."""
    ends = _road_points(camera, truth.segments_px.reshape(-1, 2)).reshape(-1, 2, 2)
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1)
    distance = np.abs(lengths - truth.segments_m)
    first, second = np.triu_indices(len(lengths), k=1)
    true_ratio = truth.segments_m[first] / truth.segments_m[second]
    ratio = np.abs(lengths[first] / lengths[second] - true_ratio)
    return ratio, ratio / true_ratio * 100, distance, distance / truth.segments_m * 100


def score_recording(truth: GroundTruth, tracks: Tracks, camera: Camera) -> RecordingScore:
    """Score the tracks of one recording.

    Args:
        truth: ground truth of the recording.
        tracks: as read from the result file.
        camera: calibration to measure with; it needs a scale.

    Raises:
        CalibrationError: the camera has no scale.
    """
    tracks_read = len(tracks) + sum(tracks.dropped.values())
    tracks = prefilter(tracks, truth)
    last, first = (line_crossings(tracks, truth.measurement_lines[number]) for number in (0, -1))
    lanes = lanes_of(last.points_px, truth.lane_lines)
    measurable = last.finite & first.finite & (lanes >= 0) & (lanes_of(first.points_px, truth.lane_lines) >= 0)
    speeds = gap_speeds_kmh(_road_points(camera, tracks.points_px), tracks.frames / truth.fps, tracks.offsets)
    measurable &= np.isfinite(speeds)

    rows = np.flatnonzero(measurable)
    times_s = last.frames[rows] / truth.fps
    match = _match(truth, times_s, lanes[rows])
    failures = len(tracks) - len(rows)
    unmatched = _count_unmatched(truth, times_s, [tracks.ids[i] for i in rows], match)
    matched = match >= 0
    measured = np.full(len(truth), np.nan)
    measured[matched] = speeds[rows[match[matched]]]
    ratio, ratio_relative, distance, distance_relative = _calibration_errors(truth, camera)
    return RecordingScore(
        truth_kmh=truth.speeds_kmh,
        valid=truth.valid,
        matched=matched,
        counted=matched & truth.valid,
        speeds_kmh=measured,
        false_positives=unmatched + failures,
        intersection_failures=failures,
        ratio_errors=ratio,
        ratio_errors_relative=ratio_relative,
        distance_errors_m=distance,
        distance_errors_relative=distance_relative,
        tracks_read=tracks_read,
        dropped=dict(tracks.dropped),
    )
