"""Parts of the frame that a network sees enlarged, so that distant vehicles are large enough for it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError
from labelgen.geometry.camera import Camera
from labelgen.masks.onnx.placement import Window

__all__ = ["TILE_SETTINGS", "TileSettings", "check_tiles", "choose_windows", "vehicle_heights"]


@dataclass(frozen=True)
class TileSettings:
    """How tiles are chosen."""

    wanted_px: float = 40.0
    """Height from which on a car is large enough in the network's picture, px."""
    least_px: float = 8.0
    """Least height of cars that are looked for, px of the frame."""
    max_enlargement: float = 4.0
    """Largest enlargement of the frame: more shows the network nothing new."""
    max_tiles: int = 12
    """Largest number of tiles; each costs a run of the network."""
    grid_overlap: float = 0.2
    """Overlap of neighbouring tiles of a grid, as a share of a tile."""
    vehicle_heights: float = 1.5
    """Overlap and border of tiles along the road, in heights of the largest car that is looked for in them."""
    car_height_m: float = 1.5
    """Height of a car, metres."""
    camera_height_m: float = 8.0
    """Height of a camera whose calibration has no scale, metres."""


TILE_SETTINGS = TileSettings()


def check_tiles(tiles: str | None, camera: Camera | None) -> tuple[int, int] | None:
    """Return columns and rows of tiles written as "3x2"; None for "auto" and for no tiles.

    Raises:
        LabelgenError: written otherwise, or "auto" without a camera.
    """
    if tiles == "auto" and camera is None:
        raise LabelgenError(
            "tiles auto: they are chosen by the calibration, and there is none here; give columns and rows, as 3x2",
            parameter="tiles",
        )
    if tiles is None or tiles == "auto":
        return None
    match = re.fullmatch(r"([1-9])[xX×]([1-9])", tiles.strip())
    if match is None:
        raise LabelgenError(f"tiles {tiles}: expected auto, or columns and rows as 3x2", parameter="tiles")
    return int(match[1]), int(match[2])


def choose_windows(
    tiles: str | None,
    frame_wh: tuple[int, int],
    picture_wh: tuple[int, int],
    camera: Camera | None,
    road_mask: NDArray[Any] | None,
    settings: TileSettings = TILE_SETTINGS,
) -> list[Window]:
    """Return the parts of the frame that a network looks at; the first is the whole frame.

    Args:
        tiles: None for no parts; columns and rows as "3x2"; or "auto": those parts of the road in which cars are small
            in the network's picture of the whole frame, in steps of twice the size.
        frame_wh: size of the frames, px.
        picture_wh: size of the network's picture of the whole frame, px.
        camera: of the frames, for "auto".
        road_mask: (H, W), not 0 on the road, for "auto"; None for everything below the horizon.
        settings: sizes and numbers.

    Raises:
        LabelgenError: tiles that cannot be.
    """
    whole: Window = (0, 0, *frame_wh)
    grid = check_tiles(tiles, camera)
    if grid is not None:
        x, y = (
            _spread(0, side, side / (n - (n - 1) * settings.grid_overlap), n)
            for side, n in zip(frame_wh, grid, strict=True)
        )
        return [whole, *([(a, c, b, d) for c, d in y for a, b in x] if grid != (1, 1) else [])]
    if tiles is None or camera is None:
        return [whole]
    heights = vehicle_heights(camera, frame_wh, settings)
    on_road = np.ones(heights.shape, np.bool_) if road_mask is None else np.asarray(road_mask) != 0
    heights = np.where(on_road & (heights >= settings.least_px), heights, np.inf)
    windows = [whole]
    scale = 2 * min(picture_wh[0] / frame_wh[0], picture_wh[1] / frame_wh[1])
    while scale <= settings.max_enlargement:
        level = _level(heights, scale, picture_wh, settings)
        if not level or len(windows) + len(level) > settings.max_tiles + 1:
            break
        windows += level
        scale *= 2
    return windows


def vehicle_heights(
    camera: Camera, frame_wh: tuple[int, int], settings: TileSettings = TILE_SETTINGS
) -> NDArray[np.float64]:
    """Return how high a car is that stands on the road at each pixel (H, W), px; 0 above the horizon."""
    x, y = np.meshgrid(np.arange(frame_wh[0]) + 0.5, np.arange(frame_wh[1]) + 0.5)
    down = -camera.rays(np.stack([x, y], axis=-1))[..., 2]
    upright = np.sqrt(max(0.0, 1 - float(camera.axes[2, 2]) ** 2))
    height_m = settings.camera_height_m if camera.scale is None else camera.height_m
    heights: NDArray[np.float64] = np.maximum(down, 0) * upright * settings.car_height_m / height_m
    return heights


def _level(
    heights: NDArray[np.float64], scale: float, picture_wh: tuple[int, int], settings: TileSettings
) -> list[Window]:
    """Return tiles of a scale, px of the picture a px of the frame, for cars too small at half of it."""
    largest = settings.wanted_px / (scale / 2)
    rows, columns = np.nonzero(heights < largest)
    if not rows.size:
        return []
    border = settings.vehicle_heights * largest
    frame_h, frame_w = heights.shape
    spans = []
    for low, high, side, picture in (
        (columns.min(), columns.max() + 1, frame_w, picture_wh[0]),
        # Cars stand above their place on the road.
        (rows.min(), rows.max() + 1, frame_h, picture_wh[1]),
    ):
        start, stop = max(0.0, low - border / 2), min(float(side), high + border / 2)
        tile = min(picture / scale, float(side))
        if stop - start <= tile:
            start = min(max(0.0, (start + stop - tile) / 2), side - tile)
            stop = start + tile
        count = 1 + int(np.ceil((stop - start - tile) / max(tile - border, tile / 2)))
        spans.append(_spread(start, stop, tile, count))
    return [(a, c, b, d) for c, d in spans[1] for a, b in spans[0]]


def _spread(start: float, stop: float, length: float, count: int) -> list[tuple[int, int]]:
    """Return so many stretches of equal length, the first at the start, the last at the end."""
    first = np.linspace(start, max(start, stop - length), count).round().astype(int)
    return [(int(low), int(min(low + round(length), round(stop)))) for low in first]
