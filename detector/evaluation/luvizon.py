"""The evaluation protocol of the Luvizon data set: recall, and the share of speed errors within [-3, +2] km/h.

One calibration serves all lanes, with a scale factor for each. Errors are measured minus true. The public script takes
the opposite sign, so the share with that sign is given too.

Source: Luvizon, Nassu, Minetto, "A Video-Based System for Vehicle Speed Measurement in Urban Roadways", IEEE T-ITS
2017.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import ArrayLike

from detector.evaluation.results_folder import result_file_name
from detector.evaluation.summary import Value
from detector.tracking.per_track import gap_speeds_kmh
from detector.tracking.tracks import Tracks, read_results
from labelgen.datasets.luvizon import LANES, LuvizonVideo, read_luvizon_video
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array, IntArray, apply_homography

__all__ = [
    "LuvizonRules",
    "LuvizonScore",
    "ScoredVideo",
    "luvizon_row",
    "score_luvizon",
    "score_luvizon_results",
    "track_lanes",
]


@dataclass(frozen=True)
class LuvizonRules:
    """Constants of the data set's evaluation. Scores with other values cannot be compared with published ones.

    Args:
        fps: frames per second of the videos.
        limits_kmh: km/h; lowest and highest error that authorities in several countries accept.
    """

    fps: float = 30.15
    limits_kmh: tuple[float, float] = (-3.0, 2.0)


_RULES = LuvizonRules()


@dataclass(frozen=True, eq=False)
class LuvizonScore:
    """Score of one system on one video, with V vehicles that count.

    Args:
        lanes: (V,) lane numbers.
        truth_kmh: (V,) true speeds.
        speeds_kmh: (V,) measured speeds; NaN where no track is matched.
        tracks: (V,) number of the matched track; -1 for none.
        tracks_read: number of cars in the result file.
        tracks_unused: number of tracks without a lane or without a speed.
    """

    lanes: IntArray
    truth_kmh: Array
    speeds_kmh: Array
    tracks: IntArray
    tracks_read: int
    tracks_unused: int


@dataclass(frozen=True, eq=False)
class ScoredVideo:
    """Score of one result file, with the names of video and system and of the file in the results folder."""

    video: str
    system: str
    tracks: str
    score: LuvizonScore


def track_lanes(tracks: Tracks, video: LuvizonVideo) -> IntArray:
    """Return (N,) the lane in which most points of each track lie; 0 for tracks with no point in a lane."""
    x, y = tracks.points_px.T
    numbers = sorted(video.lane_areas)
    counts = [tracks.count(shapely.intersects_xy(video.lane_areas[lane], x, y)) for lane in numbers]
    most = np.argmax(counts, axis=0)
    lanes: IntArray = np.where(np.max(counts, axis=0) > 0, np.array(numbers)[most], 0)
    return lanes


def _speeds_kmh(tracks: Tracks, video: LuvizonVideo, lanes: IntArray, camera: Camera | None, scales: Array) -> Array:
    """Return (N,) speeds with the scale of each lane; NaN for tracks without a lane."""
    if camera is None:
        matrices = np.concatenate([np.eye(3)[None], video.homographies])[lanes[tracks.track_numbers]]
        points = apply_homography(matrices, tracks.points_px[:, None], behind="keep")[:, 0]
    else:
        points = camera.road_points(tracks.points_px, invalid="nan")
    speeds = gap_speeds_kmh(points, tracks.frames / _RULES.fps, tracks.offsets)
    scaled: Array = speeds * np.concatenate([[np.nan], scales])[lanes]
    return scaled


def _match(video: LuvizonVideo, tracks: Tracks, lanes: IntArray) -> IntArray:
    """Match vehicles, in file order, with the free track of their lane that has the best temporal IoU.

    Returns:
        (V,) number of the track; -1 for none. Each track is taken once.
    """
    match = np.full(len(video), -1)
    if not len(tracks):
        return match
    # A track reaches from its first to its last frame, whatever the order of its points.
    first = np.minimum.reduceat(tracks.frames, tracks.offsets[:-1])
    last = np.maximum.reduceat(tracks.frames, tracks.offsets[:-1])
    free = lanes > 0
    for vehicle, (begin, end) in enumerate(video.frames):
        overlap = np.minimum(last, end) - np.maximum(first, begin) + 1
        union = np.maximum(last, end) - np.minimum(first, begin) + 1
        iou = np.where(free & (lanes == video.lanes[vehicle]), overlap / union, 0.0)
        best = int(np.argmax(iou))
        if iou[best] > 0:
            match[vehicle] = best
            free[best] = False
    return match


def score_luvizon(
    video: LuvizonVideo, tracks: Tracks, camera: Camera | None, lane_scales: ArrayLike = (1.0,) * LANES
) -> LuvizonScore:
    """Score the tracks of one video.

    Args:
        video: ground truth of the video.
        tracks: as read from a result file.
        camera: calibration for all lanes, with a scale; None takes the homographies of the data set.
        lane_scales: (3,) factors by which the distances of each lane are multiplied.

    Raises:
        CalibrationError: the camera has no scale, or `lane_scales` are not three positive numbers.
    """
    scales = np.asarray(lane_scales, dtype=np.float64)
    if scales.shape != (LANES,) or not (np.isfinite(scales) & (scales > 0)).all():
        raise CalibrationError(
            f"lane_scales: expected {LANES} positive numbers, got {lane_scales!r}", parameter="lane_scales"
        )
    lanes = track_lanes(tracks, video)
    speeds = _speeds_kmh(tracks, video, lanes, camera, scales)
    lanes = np.where(np.isfinite(speeds), lanes, 0)
    match = _match(video, tracks, lanes)
    measured = np.full(len(video), np.nan)
    measured[match >= 0] = speeds[match[match >= 0]]
    return LuvizonScore(
        lanes=video.lanes,
        truth_kmh=video.speeds_kmh,
        speeds_kmh=measured,
        tracks=match,
        tracks_read=len(tracks) + sum(tracks.dropped.values()),
        tracks_unused=int(np.count_nonzero(lanes == 0)),
    )


def score_luvizon_results(
    dataset: Path, results: Path, videos: Sequence[str], systems: Sequence[str]
) -> Iterator[ScoredVideo]:
    """Score systems on videos, one after the other; the systems of a video follow each other.

    The file of a system for a video is RESULTS/subset01/video01/system_NAME.json, in the public result format. Its
    `camera_calibration` may hold `lane_scales`, three factors on top of `scale`.

    Args:
        dataset: folder of the subsets.
        results: folder of the result files.
        videos: names, as `labelgen.datasets.luvizon.select_videos` returns them.
        systems: names of the systems.

    Raises:
        DataError: a file is missing or not of its format.
        CalibrationError: a calibration is missing or describes no camera.
    """
    for name in videos:
        video = read_luvizon_video(dataset / name)
        for system in systems:
            file = read_results(results / name / result_file_name(system))
            score = score_luvizon(video, file.tracks, file.camera(), file.lane_scales())
            yield ScoredVideo(name, system, file.path.name, score)


def luvizon_row(scores: Sequence[LuvizonScore]) -> dict[str, Value]:
    """Return figures over all vehicles of one or more videos; None where there is nothing to average.

    Returns:
        `vehicles`, `matched`, `recall`. `within_matched` and `within_all`: the shares of matched and of all vehicles
        whose error lies in [-3, +2] km/h. `within_matched_public` and `within_all_public`: the same with the opposite
        sign of the public script. `bias`: mean of the error in km/h. `mean`, `median`, `p95`, `worst`: of the absolute
        error in km/h.
    """
    errors = np.concatenate([score.speeds_kmh - score.truth_kmh for score in scores])
    vehicles = len(errors)
    errors = errors[np.isfinite(errors)]
    low, high = _RULES.limits_kmh
    within = int(np.count_nonzero((errors >= low) & (errors <= high)))
    within_public = int(np.count_nonzero((-errors >= low) & (-errors <= high)))
    absolute = np.abs(errors)
    matched = len(errors)
    row: dict[str, Value] = {"vehicles": vehicles, "matched": matched}
    row["recall"] = matched / vehicles if vehicles else None
    for name, count in (("", within), ("_public", within_public)):
        row[f"within_matched{name}"] = count / matched if matched else None
        row[f"within_all{name}"] = count / vehicles if vehicles else None
    row["bias"] = float(errors.mean()) if matched else None
    row["mean"] = float(absolute.mean()) if matched else None
    for name, percent in (("median", 50), ("p95", 95), ("worst", 100)):
        row[name] = float(np.percentile(absolute, percent)) if matched else None
    return row
