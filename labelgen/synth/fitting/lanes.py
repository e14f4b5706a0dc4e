"""Lanes of somebody's own road: where traffic drives, where paint lies between, which way and how fast it goes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.synth.scene.scene import Lane

__all__ = ["find_lanes"]

_FEATURE_M = 0.7
"""Usual height of what is followed on vehicles."""
_WIDTHS = np.arange(2.9, 4.0, 0.05)
_USUAL_M, _USUAL_SPREAD = 3.5, 0.35
_CELL = 0.05
_LEAST_SHARE, _LEAST_TRACKS = 0.06, 6
_LEAST_MOVE_M = 3.0
_SNAP_M = 0.35
_SPEEDS = (20.0, 150.0)
_ASSUMED_KMH = 70.0

Array = NDArray[np.float64]


def find_lanes(
    camera: Camera, road: NDArray[np.bool_], empty: NDArray[np.uint8], tracks: Sequence[Track], heading: int | None
) -> tuple[tuple[Lane, ...], Array]:
    """The lanes of a straight road.

    Args:
        camera: with a scale, for frames of the mask's size.
        road: (H, W) road mask.
        empty: (H, W, 3) uint8 BGR, the empty road, whose markings part the lanes.
        tracks: features on what moved.
        heading: +1 all traffic drives away, -1 it comes closer; by the tracks, for each lane, when None.

    Returns:
        the lanes, and the (n + 1,) borders, metres, of those that are measured: neighbours of one heading, with the
        most traffic.

    Raises:
        DataError: the mask holds no lane, or nothing says which way traffic goes.
    """
    low, high = _span(camera, road)
    if high - low < 2.2:
        raise DataError(
            f"road mask: {max(high - low, 0):.1f} m across leave no room for a lane; check the mask and the scale"
        )
    at, way, kmh = _passes(camera, tracks, low, high)
    if heading is None and len(at) < _LEAST_TRACKS:
        raise DataError("the video shows too little traffic to tell which way it drives; give --heading away or closer")
    centres: Array = low + _CELL * (np.arange(int((high - low) / _CELL), dtype=np.float64) + 0.5)
    borders = _borders(low, high, _paint(camera, road, empty, centres), at, centres)
    lanes, counts = [], []
    for a, b in pairwise(borders.tolist()):
        here = (at >= a) & (at < b)
        along = heading or (1 if way[here].sum() > 0 else -1 if way[here].sum() < 0 else 0)
        counts.append(int(np.count_nonzero(here & (way == along))))
        usual = kmh[here] if here.any() else kmh
        speed = float(np.clip(np.median(usual), *_SPEEDS)) if len(usual) else _ASSUMED_KMH
        lanes.append(Lane(float((a + b) / 2), 0.0, along, speed, None))
    first, last = _measured(lanes, counts)
    out = [
        Lane(lane.y0, 0.0, lane.heading, lane.speed_kmh, k - first if first <= k <= last else None)
        for k, lane in enumerate(lanes)
        if first <= k <= last or counts[k] >= max(2.0, _LEAST_SHARE * max(counts))
    ]
    return tuple(out), np.asarray(borders[first : last + 2])


def _span(camera: Camera, road: NDArray[np.bool_]) -> tuple[float, float]:
    """Y from and to, metres, of the road in the mask where most of it is nearest."""
    rows, columns = np.nonzero(road)
    pick = slice(None, None, max(1, len(rows) // 40000))
    ground = camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")
    ground = ground[np.isfinite(ground).all(axis=1)]
    if not len(ground):
        return 0.0, 0.0
    near = ground[ground[:, 0] < np.quantile(ground[:, 0], 0.8)]
    low, high = np.quantile(near[:, 1], [0.005, 0.995])
    return float(low), float(high)


def _passes(camera: Camera, tracks: Sequence[Track], low: float, high: float) -> tuple[Array, Array, Array]:
    """Per track on the road: Y in metres, +1 or -1 for its way, km/h."""
    out = []
    # Seen from above, what is higher than the road appears farther away.
    shrink = 1 - _FEATURE_M / camera.height_m
    for track in tracks:
        points = camera.road_points(track.points_px[[0, -1]], invalid="nan") * shrink
        time = float(track.times_s[-1] - track.times_s[0])
        moved = points[1] - points[0]
        if not np.isfinite(points).all() or time <= 0 or abs(moved[0]) < _LEAST_MOVE_M:
            continue
        y = float(points[:, 1].mean())
        if abs(moved[1]) < 0.3 * abs(moved[0]) and low <= y <= high:
            out.append((y, float(np.sign(moved[0])), abs(float(moved[0])) / time * 3.6))
    return tuple(np.array(out).reshape(-1, 3).T)  # type: ignore[return-value]


def _paint(camera: Camera, road: NDArray[np.bool_], empty: NDArray[np.uint8], centres: Array) -> Array:
    """How much brighter than its neighbourhood the road is at each Y: lane markings stand out."""
    rows, columns = np.nonzero(road)
    x = camera.road_points(np.stack([columns, rows], axis=1)[:: max(1, len(rows) // 5000)] + 0.5, invalid="nan")[:, 0]
    along = np.linspace(np.nanmin(x), min(float(np.nanquantile(x, 0.7)), np.nanmin(x) + 45), 160)
    grid = np.stack(np.meshgrid(along, centres, indexing="ij"), axis=-1)
    pixels = camera.project(grid.reshape(-1, 2)).reshape(grid.shape).astype(np.float32)
    grey = cv2.cvtColor(empty, cv2.COLOR_BGR2GRAY)
    seen = cv2.remap(grey, pixels[..., 0] - 0.5, pixels[..., 1] - 0.5, cv2.INTER_LINEAR).astype(np.float32)
    inside = cv2.remap(road.astype(np.float32), pixels[..., 0] - 0.5, pixels[..., 1] - 0.5, cv2.INTER_LINEAR) > 0.5
    wide = int(0.8 / _CELL) | 1
    raised = np.maximum(seen - cv2.blur(seen, (wide, 1)), 0) * inside
    profile = raised.sum(axis=0) / np.maximum(inside.sum(axis=0), 1)
    return np.asarray(profile / max(float(profile.max()), 1e-6), dtype=np.float64)


def _borders(low: float, high: float, paint: Array, at: Array, centres: Array) -> Array:
    """Borders of evenly wide lanes that have paint between them and traffic in their middle, moved onto the paint."""
    best = (-np.inf, _USUAL_M, low)
    soft = np.convolve(paint, np.hanning(9) / np.hanning(9).sum(), mode="same")
    for width in _WIDTHS:
        prior = -0.5 * ((width - _USUAL_M) / _USUAL_SPREAD) ** 2
        for start in np.arange(0, width, _CELL):
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
    kept = [k for k in range(len(edges) - 1) if min(edges[k + 1], high) - max(edges[k], low) > 0.75 * width]
    if not kept:
        middle = (low + high) / 2
        return np.array([middle - width / 2, middle + width / 2])
    edges = edges[kept[0] : kept[-1] + 2]
    for k, edge in enumerate(edges):
        near = np.abs(centres - edge) <= _SNAP_M
        if near.any() and soft[near].max() > 2.5 * soft.mean():
            edges[k] = centres[near][soft[near].argmax()]
    return edges


def _measured(lanes: Sequence[Lane], counts: Sequence[int]) -> tuple[int, int]:
    """First and last of the neighbouring lanes of one heading that carry the most traffic."""
    used = [
        lane.heading != 0 and n >= max(1.0, _LEAST_SHARE * max(counts)) for lane, n in zip(lanes, counts, strict=True)
    ]
    if not any(used):  # nothing was seen, but the heading is given
        used = [lane.heading != 0 for lane in lanes]
    best, at = -1, (0, 0)
    for first in range(len(lanes)):
        for last in range(first, len(lanes)):
            same = all(used[k] and lanes[k].heading == lanes[first].heading for k in range(first, last + 1))
            total = sum(counts[first : last + 1]) + (last - first)
            if same and total > best:
                best, at = total, (first, last)
    return at
