"""Lanes of a road seen in a video: from its traffic and its markings, with direction and speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.synth.scene.scene import Lane

__all__ = ["LANES", "LaneThresholds", "find_lanes"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LaneThresholds:
    """Thresholds for finding lanes.

    Args:
        feature_height_m: usual height of the features that are tracked on vehicles.
        width_range_m, width_step_m: lane widths that are tried.
        usual_width_m, width_std_m: prior of the width.
        cell_m: resolution across the road.
        min_road_m: width of the road mask below which it holds no lane.
        min_traffic_share: share of the busiest lane's vehicles below which a lane does not count as used.
        min_tracks: tracks below which the direction of traffic is not taken from them.
        min_move_m: distance that a track must cover along the road.
        snap_m: distance over which a border moves onto a marking.
        speed_range_kmh: speeds that are believed.
        assumed_kmh: speed of a lane without tracks.
    """

    feature_height_m: float = 0.7
    width_range_m: tuple[float, float] = (2.9, 4.0)
    width_step_m: float = 0.05
    usual_width_m: float = 3.5
    width_std_m: float = 0.35
    cell_m: float = 0.05
    min_road_m: float = 2.2
    min_traffic_share: float = 0.06
    min_tracks: int = 6
    min_move_m: float = 3.0
    snap_m: float = 0.35
    speed_range_kmh: tuple[float, float] = (20.0, 150.0)
    assumed_kmh: float = 70.0


LANES = LaneThresholds()


def find_lanes(
    camera: Camera,
    road: NDArray[np.bool_],
    background: NDArray[np.uint8],
    tracks: Sequence[Track],
    heading: int | None,
    thresholds: LaneThresholds = LANES,
) -> tuple[tuple[Lane, ...], Array]:
    """Find the lanes of a straight road.

    Args:
        camera: with a scale, for frames of the mask's size.
        road: (H, W) road mask.
        background: (H, W, 3) uint8 BGR, the road without traffic.
        tracks: of features on vehicles.
        heading: +1 all traffic drives away, -1 it comes closer; for each lane by its tracks when None.
        thresholds: of this stage.

    Returns:
        The lanes, and the (n + 1,) borders, metres, of those that are measured: neighbours of one heading, with the
        most traffic.

    Raises:
        DataError: the mask holds no lane, or too few tracks show the direction of traffic.
    """
    low, high = _span(camera, road)
    if high - low < thresholds.min_road_m:
        raise DataError(
            f"road mask: {max(high - low, 0):.1f} m across leave no room for a lane; check the mask and the scale"
        )
    at, way, kmh = _passes(camera, tracks, (low, high), thresholds)
    if heading is None and len(at) < thresholds.min_tracks:
        raise DataError(
            "heading: the video shows too little traffic to tell which way it drives; give it", parameter="heading"
        )
    cells = np.arange(int((high - low) / thresholds.cell_m), dtype=np.float64)
    centres: Array = low + thresholds.cell_m * (cells + 0.5)
    paint = _paint(camera, road, background, centres, thresholds.cell_m)
    borders = _borders((low, high), paint, at, centres, thresholds)
    lanes, counts = [], []
    for a, b in pairwise(borders.tolist()):
        here = (at >= a) & (at < b)
        along = heading or (1 if way[here].sum() > 0 else -1 if way[here].sum() < 0 else 0)
        counts.append(int(np.count_nonzero(here & (way == along))))
        usual = kmh[here] if here.any() else kmh
        speed = float(np.clip(np.median(usual), *thresholds.speed_range_kmh)) if len(usual) else thresholds.assumed_kmh
        lanes.append(Lane(float((a + b) / 2), 0.0, along, speed, None))
    first, last = _measured(lanes, counts, thresholds.min_traffic_share)
    fewest = max(2.0, thresholds.min_traffic_share * max(counts))
    out = [
        Lane(lane.y0, 0.0, lane.heading, lane.speed_kmh, k - first if first <= k <= last else None)
        for k, lane in enumerate(lanes)
        if first <= k <= last or counts[k] >= fewest
    ]
    return tuple(out), np.asarray(borders[first : last + 2])


def _span(camera: Camera, road: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the range of Y, metres, of the nearer part of the road in the mask."""
    rows, columns = np.nonzero(road)
    pick = slice(None, None, max(1, len(rows) // 40000))
    ground = camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")
    ground = ground[np.isfinite(ground).all(axis=1)]
    if not len(ground):
        return 0.0, 0.0
    near = ground[ground[:, 0] < np.quantile(ground[:, 0], 0.8)]
    low, high = np.quantile(near[:, 1], [0.005, 0.995])
    return float(low), float(high)


def _passes(
    camera: Camera, tracks: Sequence[Track], span_y: tuple[float, float], thresholds: LaneThresholds
) -> tuple[Array, Array, Array]:
    """Return per track on the road its Y in metres, its heading (+1 or -1) and its speed in km/h."""
    out = []
    low, high = span_y
    # Projected onto the road, a feature above it appears farther away.
    shrink = 1 - thresholds.feature_height_m / camera.height_m
    for track in tracks:
        points = camera.road_points(track.points_px[[0, -1]], invalid="nan") * shrink
        time = float(track.times_s[-1] - track.times_s[0])
        moved = points[1] - points[0]
        if not np.isfinite(points).all() or time <= 0 or abs(moved[0]) < thresholds.min_move_m:
            continue
        y = float(points[:, 1].mean())
        if abs(moved[1]) < 0.3 * abs(moved[0]) and low <= y <= high:
            out.append((y, float(np.sign(moved[0])), abs(float(moved[0])) / time * 3.6))
    return tuple(np.array(out).reshape(-1, 3).T)  # type: ignore[return-value]


def _paint(
    camera: Camera, road: NDArray[np.bool_], background: NDArray[np.uint8], centres: Array, cell_m: float
) -> Array:
    """Return for each Y how much brighter than its neighbourhood the road is: lane markings stand out."""
    rows, columns = np.nonzero(road)
    x = camera.road_points(np.stack([columns, rows], axis=1)[:: max(1, len(rows) // 5000)] + 0.5, invalid="nan")[:, 0]
    along = np.linspace(np.nanmin(x), min(float(np.nanquantile(x, 0.7)), np.nanmin(x) + 45), 160)
    grid = np.stack(np.meshgrid(along, centres, indexing="ij"), axis=-1)
    pixels = camera.project(grid.reshape(-1, 2)).reshape(grid.shape).astype(np.float32)
    grey = cv2.cvtColor(background, cv2.COLOR_BGR2GRAY)
    levels = cv2.remap(grey, pixels[..., 0] - 0.5, pixels[..., 1] - 0.5, cv2.INTER_LINEAR).astype(np.float32)
    inside = cv2.remap(road.astype(np.float32), pixels[..., 0] - 0.5, pixels[..., 1] - 0.5, cv2.INTER_LINEAR) > 0.5
    wide = int(0.8 / cell_m) | 1
    raised = np.maximum(levels - cv2.blur(levels, (wide, 1)), 0) * inside
    profile = raised.sum(axis=0) / np.maximum(inside.sum(axis=0), 1)
    return np.asarray(profile / max(float(profile.max()), 1e-6), dtype=np.float64)


def _borders(span_y: tuple[float, float], paint: Array, at: Array, centres: Array, thresholds: LaneThresholds) -> Array:
    """Return borders of equally wide lanes with paint between them and traffic in their middle."""
    low, high = span_y
    best = (-np.inf, thresholds.usual_width_m, low)
    soft = np.convolve(paint, np.hanning(9) / np.hanning(9).sum(), mode="same")
    for width in np.arange(*thresholds.width_range_m, thresholds.width_step_m):
        prior = -0.5 * ((width - thresholds.usual_width_m) / thresholds.width_std_m) ** 2
        for start in np.arange(0, width, thresholds.cell_m):
            edges = np.arange(low + start, high + 0.01, width)
            if not len(edges):
                continue
            marked = float(np.interp(edges, centres, soft).mean()) - float(soft.mean())
            phase = np.cos(2 * np.pi * (at - edges[0] - width / 2) / width).mean() if len(at) else 0.0
            score = 4 * marked + 1.2 * float(phase) + 0.25 * prior
            best = max(best, (score, float(width), float(edges[0])))
    _, width, start = best
    edges = np.arange(start - width * np.floor((start - low) / width), high + 0.01, width)
    edges = np.unique(np.round(np.r_[edges[0] - width, edges, edges[-1] + width], 4))
    # A lane must lie in the mask for the most part.
    inside = [k for k in range(len(edges) - 1) if min(edges[k + 1], high) - max(edges[k], low) > 0.75 * width]
    if not inside:
        middle = (low + high) / 2
        return np.array([middle - width / 2, middle + width / 2])
    edges = edges[inside[0] : inside[-1] + 2]
    for k, edge in enumerate(edges):
        near = np.abs(centres - edge) <= thresholds.snap_m
        if near.any() and soft[near].max() > 2.5 * soft.mean():
            edges[k] = centres[near][soft[near].argmax()]
    return edges


def _measured(lanes: Sequence[Lane], counts: Sequence[int], min_share: float) -> tuple[int, int]:
    """Return the first and the last of the neighbouring lanes of one heading that carry the most traffic."""
    used = [lane.heading != 0 and n >= max(1.0, min_share * max(counts)) for lane, n in zip(lanes, counts, strict=True)]
    if not any(used):  # no tracks, but the heading is given
        used = [lane.heading != 0 for lane in lanes]
    best, at = -1, (0, 0)
    for first in range(len(lanes)):
        for last in range(first, len(lanes)):
            same = all(used[k] and lanes[k].heading == lanes[first].heading for k in range(first, last + 1))
            total = sum(counts[first : last + 1]) + (last - first)
            if same and total > best:
                best, at = total, (first, last)
    return at
