"""The road as the part of the frame in which things move along VP1.

The optical flow is sparse: tracks of features on moving things (`labelgen.calibration.observation.klt_tracks`). Those
that run along the line to VP1 are drawn into a small image, each counting once where it passes. What few tracks cross,
or what others cross as well, does not count. The rest is cleaned and made straight: strips between lines to VP1, from
the farthest motion down to the frame's border. The part near the horizon is cut off: it could not be rectified.

The mask therefore holds what vehicles on the road cover, up to their roofs, and not only where their tyres roll. Masks
drawn by hand for this purpose hold the same.
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
from labelgen.calibration.road_units import unit_camera
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["RoadMaskEstimate", "RoadMaskSettings", "estimate_road_mask", "write_mask"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class RoadMaskSettings:
    """How the road is marked; px are those of the small image."""

    width_px: int = 320
    """Width of the small image; a larger one gives finer borders and needs more tracks."""
    min_track_px: float = 8.0
    """Shortest track whose direction is used."""
    along_deg: float = 8.0
    """A track within this angle of the line to VP1 runs along it, degrees."""
    line_px: int = 5
    """Width of a drawn track; a larger one fills gaps between tracks and widens the road."""
    min_passes: float = 2.0
    """Fewest tracks that must pass a pixel."""
    min_pass_share: float = 0.06
    """Likewise, as a share of what passes the busiest tenth; larger values drop lanes with little traffic."""
    min_along_share: float = 0.5
    """Least share of the tracks through a pixel that run along VP1."""
    horizon_margin: float = 0.06
    """Least distance below the horizon, as a share of the height; what is nearer cannot be rectified."""
    close_share: float = 0.03
    """Holes narrower than this share of the width are closed."""
    min_piece_share: float = 0.1
    """Pieces smaller than this share of the largest are dropped."""
    far_percentile: float = 99.5
    """The road ends where this percentage of its support is nearer."""
    strips: int = 160
    """Strips along the road; more give finer borders."""
    min_strip_share: float = 0.3
    """A strip counts when supported over this share of what the best ones are; larger values narrow the road."""
    best_strips: float = 0.9
    """Quantile of the strips' support that stands for the best ones."""
    min_tracks: int = 10
    """Fewest tracks along VP1."""
    min_area: float = 0.01
    """Least share of the frame that is road."""


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


@dataclass(frozen=True, eq=False)
class _TrackCounts:
    """How many tracks pass each pixel.

    Args:
        towards, away: (h, w) along VP1, in either direction of travel.
        other: (h, w) in any other direction.
        along_count, count: tracks along VP1, and all of them.
    """

    towards: Array
    away: Array
    other: Array
    along_count: int
    count: int


def estimate_road_mask(
    camera: Camera, tracks: Sequence[Track], settings: RoadMaskSettings | None = None
) -> RoadMaskEstimate:
    """Mark the road in a video.

    Args:
        camera: with the frame's size; it needs no scale.
        tracks: features on what moved in the video.
        settings: thresholds.

    Raises:
        CalibrationError: nothing, or too little, moves along VP1.
    """
    settings = settings or RoadMaskSettings()
    assert camera.image_wh is not None
    factor = settings.width_px / camera.image_wh[0]
    small = camera.resized(factor)
    assert small.image_wh is not None
    shape = small.image_wh[::-1]
    counts = _count_tracks(small, factor, tracks, shape, settings)
    along = counts.towards + counts.away
    pixels = np.zeros(shape, dtype=np.bool_)
    if counts.along_count >= settings.min_tracks:
        busy = float(np.quantile(along[along > 0], 0.9))
        often = max(settings.min_passes, settings.min_pass_share * busy)
        support = (along >= often) & (along >= settings.min_along_share * (along + counts.other))
        support &= _below_horizon(small, shape, settings.horizon_margin)
        pixels = _straighten(small, _closed(support, settings), counts.towards - counts.away, settings)
    if pixels.mean() < settings.min_area:
        reason = "nothing moves" if not counts.along_count else "too little moves"
        raise CalibrationError(
            f"road mask: {reason} along VP1 ({counts.along_count} of {counts.count} tracks run along it); use a part "
            "of the video with traffic, or check the calibration"
        )
    levels = cv2.resize(pixels.astype(np.uint8) * 255, camera.image_wh, interpolation=cv2.INTER_LINEAR)
    share = counts.along_count / max(1, counts.count)
    return RoadMaskEstimate(np.asarray(levels >= 128, dtype=np.bool_), counts.along_count, share)


def write_mask(path: Path, pixels: Mask) -> None:
    """Write a mask (H, W) bool as PNG, 255 where it is set; makes the folder.

    Raises:
        OutputError: the file cannot be written.
    """
    make_folder(path.absolute().parent)
    write_atomic(path, bytes(cv2.imencode(".png", pixels.astype(np.uint8) * 255)[1]))


def _count_tracks(
    small: Camera, factor: float, tracks: Sequence[Track], shape: tuple[int, ...], settings: RoadMaskSettings
) -> _TrackCounts:
    """Draw tracks (full-frame px) into a small image of a shape (h, w), and count them per pixel."""
    towards, away, other = np.zeros((3, *shape), dtype=np.uint32)
    along_count = count = 0
    min_cosine = np.cos(np.radians(settings.along_deg))
    for track in tracks:
        points = track.points_px * factor
        moved, middle = points[-1] - points[0], points.mean(axis=0)
        length, to_vp1 = float(np.hypot(*moved)), small.vp1 - middle
        if length < settings.min_track_px:
            continue
        cosine = float(moved @ to_vp1) / (length * max(float(np.hypot(*to_vp1)), 1e-9))
        count += 1
        is_along = abs(cosine) > min_cosine
        along_count += int(is_along)
        target = (towards if cosine > 0 else away) if is_along else other
        low = np.maximum(np.floor(points.min(axis=0)).astype(int) - settings.line_px, 0)
        high = np.ceil(points.max(axis=0)).astype(int) + settings.line_px
        part = target[low[1] : high[1], low[0] : high[0]]
        drawn = np.zeros(part.shape, dtype=np.uint8)
        cv2.polylines(drawn, [np.round(points - low - 0.5).astype(np.int32)], False, 1, settings.line_px)
        part += drawn
    towards, away, other = (a.astype(np.float64) for a in (towards, away, other))
    return _TrackCounts(towards, away, other, along_count, count)


def _pixel_centres(shape: tuple[int, ...]) -> Array:
    """Return the centres (h, w, 2) px of the pixels of a shape (h, w)."""
    return np.stack(np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5), axis=-1)


def _below_horizon(small: Camera, shape: tuple[int, ...], margin: float) -> Mask:
    """(h, w) the pixels farther below the line through VP1 and VP2 than a share of the height."""
    # The horizon is where the third coordinate of a pixel's ray, an affine function of the pixel, is 0.
    origin, right, down = small.rays(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))[:, 2]
    depth = -small.rays(_pixel_centres(shape))[..., 2] / np.hypot(right - origin, down - origin)
    return np.asarray(depth > margin * shape[0])


def _closed(support: Mask, settings: RoadMaskSettings) -> Mask:
    """Return the larger parts of a mask (h, w), without specks and without small holes."""
    size = max(3, int(settings.close_share * support.shape[1])) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    clean = cv2.morphologyEx(support.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    clean = cv2.morphologyEx(np.pad(clean, size), cv2.MORPH_CLOSE, disc)[size:-size, size:-size]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(clean))
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= settings.min_piece_share * areas.max(initial=0)))


def _straighten(small: Camera, support: Mask, towards: Array, settings: RoadMaskSettings) -> Mask:
    """Return the support as strips between lines to VP1, from a line across the road down to the frame's border.

    A strip counts where much of it, from the far end of the support to the near one, is supported. All strips from the
    first to the last of one direction of travel are one carriageway. It reaches the frame's border, where fast vehicles
    are in too few frames to be followed.

    Args:
        small: camera of the small image.
        support: (h, w).
        towards: (h, w) how many more tracks run towards VP1 than away from it.
        settings: thresholds.
    """
    if not support.any():
        return support
    below = _below_horizon(small, support.shape, settings.horizon_margin)
    ground = unit_camera(small).road_points(_pixel_centres(support.shape), invalid="nan")
    far = float(np.percentile(ground[support][:, 0], settings.far_percentile))
    road = below & (ground[..., 0] <= far)
    # On the road a line to VP1 is a line of one Y.
    across = np.where(road, ground[..., 1], np.nan)
    supported = across[support & road]
    edges = np.linspace(float(supported.min()), float(supported.max()), settings.strips + 1)
    supported_count, _ = np.histogram(supported, edges)
    road_count, _ = np.histogram(across[road], edges)
    share = supported_count / np.maximum(road_count, 1)
    is_road = share >= settings.min_strip_share * np.quantile(share, settings.best_strips)
    runs_towards = np.histogram(supported, edges, weights=towards[support & road])[0] >= 0
    out = np.zeros(support.shape, dtype=np.bool_)
    for carriageway in (runs_towards, ~runs_towards):
        strips = np.flatnonzero(is_road & carriageway)
        if len(strips):
            with np.errstate(invalid="ignore"):
                out |= (across >= edges[strips[0]]) & (across <= edges[strips[-1] + 1])
    return out
