"""The evaluation protocol of the Luvizon data set: speed errors within [-3, +2] km/h and recall, by lanes.

One calibration serves all lanes, with a scale for each. Errors are measured minus true; the public script takes the
opposite sign, so its share is given beside ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike

from detector.evaluation.summary import Value
from detector.tracking.per_track import gap_speeds_kmh
from detector.tracking.tracks import Tracks
from labelgen.datasets.luvizon import LANES, LuvizonVideo
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array, IntArray, apply_homography

__all__ = ["FPS", "LIMITS_KMH", "LuvizonScore", "fit_lane_scales", "luvizon_row", "score_luvizon", "track_lanes"]

FPS = 30.15
LIMITS_KMH = (-3.0, 2.0)


@dataclass(frozen=True, eq=False)
class LuvizonScore:
    """What one system reached on one video; V vehicles that count.

    Args:
        lanes: (V,) lane numbers.
        truth_kmh: (V,) true speeds.
        speeds_kmh: (V,) measured speeds; NaN where no track was found.
        tracks: (V,) which track was taken; -1 for none.
        tracks_read: cars in the result file.
        tracks_unused: tracks without a lane or without a speed.
    """

    lanes: IntArray
    truth_kmh: Array
    speeds_kmh: Array
    tracks: IntArray
    tracks_read: int
    tracks_unused: int


def track_lanes(tracks: Tracks, video: LuvizonVideo) -> IntArray:
    """(N,) lane in which most of a track's points lie; 0 for tracks with no point in a lane."""
    x, y = tracks.points_px.T
    numbers = sorted(video.lane_areas)
    counts = [tracks.count(shapely.intersects_xy(video.lane_areas[lane], x, y)) for lane in numbers]
    most = np.argmax(counts, axis=0)
    lanes: IntArray = np.where(np.max(counts, axis=0) > 0, np.array(numbers)[most], 0)
    return lanes


def _speeds_kmh(tracks: Tracks, video: LuvizonVideo, lanes: IntArray, camera: Camera | None, scales: Array) -> Array:
    """(N,) speeds with each lane's scale; NaN for tracks without a lane."""
    if camera is None:
        matrices = np.concatenate([np.eye(3)[None], video.homographies])[lanes[tracks.owners]]
        points = apply_homography(matrices, tracks.points_px[:, None], behind="keep")[:, 0]
    else:
        points = camera.road_points(tracks.points_px, invalid="nan")
    speeds = gap_speeds_kmh(points, tracks.frames / FPS, tracks.offsets)
    scaled: Array = speeds * np.concatenate([[np.nan], scales])[lanes]
    return scaled


def _match(video: LuvizonVideo, tracks: Tracks, lanes: IntArray) -> IntArray:
    """(V,) for each vehicle, in file order, the free track of its lane with the best temporal IoU; -1 for none."""
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
        video: its ground truth.
        tracks: as read from a result file.
        camera: the calibration for all lanes, with a scale; None takes the publisher's homographies.
        lane_scales: (3,) factors by which each lane's distances are multiplied.

    Raises:
        CalibrationError: the camera has no scale, or the lanes' scales are not three positive numbers.
    """
    scales = np.asarray(lane_scales, dtype=np.float64)
    if scales.shape != (LANES,) or not (np.isfinite(scales) & (scales > 0)).all():
        raise CalibrationError(f"lane_scales: expected {LANES} positive numbers, got {lane_scales!r}")
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


def fit_lane_scales(scores: Sequence[LuvizonScore]) -> Array:
    """(3,) lane scales that bring the median of true / measured speed to one, from scores with scales of one.

    Take scores of the training videos here, never of those to report.

    Raises:
        CalibrationError: a lane has no matched vehicle.
    """
    if not scores:
        raise CalibrationError("no scored video to fit the lanes' scales with")
    ratios = np.concatenate([score.truth_kmh / score.speeds_kmh for score in scores])
    lanes = np.concatenate([score.lanes for score in scores])
    scales = np.empty(LANES)
    for lane in range(1, LANES + 1):
        here = ratios[(lanes == lane) & np.isfinite(ratios)]
        if not len(here):
            raise CalibrationError(f"lane {lane}: no matched vehicle to fit its scale with; score more videos")
        scales[lane - 1] = np.median(here)
    return scales


def luvizon_row(scores: Sequence[LuvizonScore]) -> dict[str, Value]:
    """Figures over all vehicles of one video or more; None where there is nothing to average.

    Returns:
        vehicles, matched, recall; within_matched and within_all, the shares of matched and of all vehicles whose
        error lies in [-3, +2] km/h; the same with the public script's opposite sign as within_matched_public and
        within_all_public; bias, mean, median, p95 and worst of the absolute error in km/h.
    """
    errors = np.concatenate([score.speeds_kmh - score.truth_kmh for score in scores])
    whole = len(errors)
    errors = errors[np.isfinite(errors)]
    low, high = LIMITS_KMH
    ours = int(np.count_nonzero((errors >= low) & (errors <= high)))
    public = int(np.count_nonzero((-errors >= low) & (-errors <= high)))
    size = np.abs(errors)
    some = len(errors)
    row: dict[str, Value] = {"vehicles": whole, "matched": some}
    row["recall"] = some / whole if whole else None
    for name, count in (("", ours), ("_public", public)):
        row[f"within_matched{name}"] = count / some if some else None
        row[f"within_all{name}"] = count / whole if whole else None
    row["bias"] = float(errors.mean()) if some else None
    row["mean"] = float(size.mean()) if some else None
    for name, percent in (("median", 50), ("p95", 95), ("worst", 100)):
        row[name] = float(np.percentile(size, percent)) if some else None
    return row
