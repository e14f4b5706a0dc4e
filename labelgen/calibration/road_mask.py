"""The road as the part of the frame in which things move along VP1.

The optical flow is sparse: tracks of features on moving things (`labelgen.calibration.observation.klt_tracks`). Those
that run along the line to VP1 are drawn into a small picture, each counting once where it passes; what few tracks
cross, or what others cross as well, does not count. The rest is cleaned and made straight: strips between lines to VP1,
from the farthest motion seen down to the frame's border. The part near the horizon is cut off: it could not be
rectified.

The mask therefore holds what vehicles on the road cover, up to their roofs, not their tyres' tracks alone; that is
what masks drawn by hand for this purpose hold too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.scale.estimate import unit_camera
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["RoadMaskEstimate", "road_mask", "write_mask"]

_WIDTH = 320
# A track this long, px of the small picture, tells its direction; within this angle of the line to VP1 it runs along.
_SHORTEST_PX, _ALONG_DEG = 8.0, 8.0
# How wide a track is drawn, how many must pass a pixel, absolutely and as a share of what passes the busiest tenth, and
# how many of all that pass it must run along VP1.
_TRACK_PX, _FEWEST, _SHARE, _ALONG_SHARE = 5, 2, 0.06, 0.5
_HORIZON_MARGIN = 0.06
_CLOSE_SHARE, _PIECE_SHARE = 0.03, 0.1
# The road ends where this share of its support lies nearer. Of the strips along it those count that are supported over
# this share of what the best ones are.
_FAR_PERCENTILE, _STRIPS, _STRIP_SHARE, _BEST_STRIPS = 99.5, 160, 0.3, 0.9
_LEAST_TRACKS, _LEAST_AREA = 10, 0.01

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RoadMaskEstimate:
    """A road mask and what it rests on.

    Args:
        pixels: (H, W) bool.
        tracks: how many features moved along VP1.
        along: their share of all features that moved.
    """

    pixels: Mask
    tracks: int
    along: float


def road_mask(camera: Camera, tracks: Sequence[Track]) -> RoadMaskEstimate:
    """The road in a video.

    Args:
        camera: with the frame's size; it needs no scale.
        tracks: features on what moved in the video.

    Raises:
        CalibrationError: nothing, or too little, moves along VP1.
    """
    assert camera.image_wh is not None
    factor = _WIDTH / camera.image_wh[0]
    small = camera.resized(factor)
    assert small.image_wh is not None
    shape = small.image_wh[::-1]
    ways, other, along_count, count = _draw(small, factor, tracks, shape)
    share = along_count / max(1, count)
    along = ways[0] + ways[1]
    pixels = np.zeros(shape, dtype=np.bool_)
    if along_count >= _LEAST_TRACKS:
        often = max(_FEWEST, _SHARE * float(np.quantile(along[along > 0], 0.9)))
        support = (along >= often) & (along >= _ALONG_SHARE * (along + other)) & _below_horizon(small, shape)
        pixels = _straight(small, _closed(support), ways[0] - ways[1])
    if pixels.mean() < _LEAST_AREA:
        seen = "nothing moves" if not along_count else "too little moves"
        raise CalibrationError(
            f"road mask: {seen} along VP1 ({along_count} of {count} tracks run along it); use a part of the video with "
            "traffic, or check the calibration"
        )
    levels = cv2.resize(pixels.astype(np.uint8) * 255, camera.image_wh, interpolation=cv2.INTER_LINEAR)
    return RoadMaskEstimate(np.asarray(levels >= 128, dtype=np.bool_), along_count, share)


def write_mask(path: Path, pixels: Mask) -> None:
    """Write a mask (H, W) as PNG, 255 where it is set."""
    make_folder(path.absolute().parent)
    write_atomic(path, bytes(cv2.imencode(".png", pixels.astype(np.uint8) * 255)[1]))


def _draw(
    small: Camera, factor: float, tracks: Sequence[Track], shape: tuple[int, ...]
) -> tuple[Array, Array, int, int]:
    """How many tracks pass each pixel: towards VP1 and away from it (2, h, w), and others (h, w); counts of tracks."""
    ways, other = np.zeros((2, *shape), dtype=np.uint32), np.zeros(shape, dtype=np.uint32)
    along_count = count = 0
    limit = np.cos(np.radians(_ALONG_DEG))
    for track in tracks:
        points = track.points_px * factor
        moved, middle = points[-1] - points[0], points.mean(axis=0)
        length, to_vp = float(np.hypot(*moved)), small.vp1 - middle
        if length < _SHORTEST_PX:
            continue
        cosine = float(moved @ to_vp) / (length * max(float(np.hypot(*to_vp)), 1e-9))
        count += 1
        along_count += int(abs(cosine) > limit)
        into = other if abs(cosine) <= limit else ways[0 if cosine > 0 else 1]
        low = np.maximum(np.floor(points.min(axis=0)).astype(int) - _TRACK_PX, 0)
        high = np.ceil(points.max(axis=0)).astype(int) + _TRACK_PX
        part = into[low[1] : high[1], low[0] : high[0]]
        drawn = np.zeros(part.shape, dtype=np.uint8)
        cv2.polylines(drawn, [np.round(points - low - 0.5).astype(np.int32)], False, 1, _TRACK_PX)
        part += drawn
    return ways.astype(np.float64), other.astype(np.float64), along_count, count


def _middles(shape: tuple[int, ...]) -> Array:
    """(h, w, 2) px, the pixels' middles."""
    return np.stack(np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5), axis=-1)


def _below_horizon(small: Camera, shape: tuple[int, ...]) -> Mask:
    """(h, w) the pixels well below the line that joins VP1 and VP2."""
    # The horizon is where the third coordinate of a pixel's ray, an affine function of the pixel, is 0.
    origin, right, down = small.rays(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))[:, 2]
    depth = -small.rays(_middles(shape))[..., 2] / np.hypot(right - origin, down - origin)
    return np.asarray(depth > _HORIZON_MARGIN * shape[0])


def _closed(support: Mask) -> Mask:
    """Support without specks and without small holes; its larger parts."""
    size = max(3, int(_CLOSE_SHARE * support.shape[1])) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    clean = cv2.morphologyEx(support.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    clean = cv2.morphologyEx(np.pad(clean, size), cv2.MORPH_CLOSE, disc)[size:-size, size:-size]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(clean))
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= _PIECE_SHARE * areas.max(initial=0)))


def _straight(small: Camera, support: Mask, towards: Array) -> Mask:
    """Support made straight: strips between lines to VP1, from a line across the road down to the frame's border.

    A strip counts where much of it, from the far end of what is supported to the near one, is supported; all from the
    first to the last of one direction of travel is one carriageway, and it goes on to the frame's border, which fast
    vehicles reach in too few frames to be followed.

    Args:
        small: camera of the small frame.
        support: (h, w).
        towards: (h, w) how many more tracks run towards VP1 than away from it.
    """
    if not support.any():
        return support
    below = _below_horizon(small, support.shape)
    ground = unit_camera(small).road_points(_middles(support.shape), invalid="nan")
    far = float(np.percentile(ground[support][:, 0], _FAR_PERCENTILE))
    road = below & (ground[..., 0] <= far)
    # On the road a line to VP1 is a line of one Y.
    across = np.where(road, ground[..., 1], np.nan)
    supported = across[support & road]
    edges = np.linspace(float(supported.min()), float(supported.max()), _STRIPS + 1)
    seen, _ = np.histogram(supported, edges)
    every, _ = np.histogram(across[road], edges)
    share = seen / np.maximum(every, 1)
    is_road = share >= _STRIP_SHARE * np.quantile(share, _BEST_STRIPS)
    way = np.histogram(supported, edges, weights=towards[support & road])[0] >= 0
    out = np.zeros(support.shape, dtype=np.bool_)
    for same in (way, ~way):
        strips = np.flatnonzero(is_road & same)
        if len(strips):
            with np.errstate(invalid="ignore"):
                out |= (across >= edges[strips[0]]) & (across <= edges[strips[-1] + 1])
    return out
