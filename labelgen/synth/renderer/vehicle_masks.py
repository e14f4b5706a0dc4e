"""Exact masks of the vehicles of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.rasterizer import visible_triangles
from labelgen.synth.vehicle.mesh import Mesh

__all__ = ["DrawnVehicle", "Layer", "body_mask", "covered_by", "visible_parts"]


@dataclass(frozen=True, eq=False)
class DrawnVehicle:
    """Exact mask and outline of a vehicle in a frame.

    Args:
        track_id: number of the vehicle.
        mask: (h, w) bool, its visible pixels without those of wing mirrors.
        origin_px: (x, y) frame px of the mask's first pixel.
        visible: share of the pixels it would cover alone that are visible.
        outline_xyxy: (4,) px, around its projected mesh without wing mirrors, hidden and outside parts included.
    """

    track_id: int
    mask: NDArray[np.bool_]
    origin_px: tuple[int, int]
    visible: float
    outline_xyxy: NDArray[np.float64]


def covered_by(drawn: Sequence[DrawnVehicle], size_hw: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return (H, W) bool: where a frame of this height and width shows vehicles."""
    out = np.zeros(size_hw, dtype=np.bool_)
    for vehicle in drawn:
        (x, y), (h, w) = vehicle.origin_px, vehicle.mask.shape
        out[y : y + h, x : x + w] |= vehicle.mask
    return out


@dataclass(frozen=True, eq=False)
class Layer:
    """Mask of one drawn vehicle before nearer vehicles are taken out of it.

    Args:
        track_id: number of the vehicle.
        mask: (h, w) bool, its pixels that no prop hides.
        alone: number of pixels that it would cover alone.
        origin_px: (x, y) frame px of the mask's first pixel.
        outline_xyxy: see `DrawnVehicle`.
    """

    track_id: int
    mask: NDArray[np.bool_]
    alone: int
    origin_px: tuple[int, int]
    outline_xyxy: NDArray[np.float64]


def body_mask(
    ids: NDArray[np.int32], screen: NDArray[np.float64], mesh: Mesh, origin: tuple[float, float]
) -> NDArray[np.bool_]:
    """Return the pixels whose centre the body of a vehicle covers.

    Args:
        ids: (h, w) which triangle of the mesh each pixel shows, -1 for none.
        screen: (V, 3) frame px x, y and depth of the mesh's vertices.
        mesh: with the parts that do not belong to the body, such as wing mirrors.
        origin: frame px of the first pixel.

    Returns:
        (h, w) bool.
    """
    mask = ids >= 0
    beside = ids >= len(mesh.body)
    rows, columns = np.flatnonzero(beside.any(axis=1)), np.flatnonzero(beside.any(axis=0))
    if len(rows):
        x, y = int(columns[0]), int(rows[0])
        part = np.s_[y : int(rows[-1]) + 1, x : int(columns[-1]) + 1]
        size = (int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y)
        mask[part] = visible_triangles(screen, mesh.body, size, (origin[0] + x, origin[1] + y), 1, True) >= 0
    return mask


def visible_parts(layers: Sequence[Layer]) -> list[DrawnVehicle]:
    """Remove from each mask what later layers cover; what props cover has been removed before."""
    drawn = []
    for i, layer in enumerate(layers):
        mask = layer.mask.copy()
        x, y = layer.origin_px
        h, w = mask.shape
        for other in layers[i + 1 :]:
            ox, oy = other.origin_px
            oh, ow = other.mask.shape
            x0, y0, x1, y1 = max(x, ox), max(y, oy), min(x + w, ox + ow), min(y + h, oy + oh)
            if x0 < x1 and y0 < y1:
                mask[y0 - y : y1 - y, x0 - x : x1 - x] &= ~other.mask[y0 - oy : y1 - oy, x0 - ox : x1 - ox]
        visible = int(np.count_nonzero(mask))
        if visible:
            drawn.append(DrawnVehicle(layer.track_id, mask, layer.origin_px, visible / layer.alone, layer.outline_xyxy))
    return drawn
