"""Detections that cannot be vehicles of their own: parts of one that was found in pieces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections
from labelgen.geometry.homography import Array

__all__ = ["fragments"]


def fragments(found: Detections) -> NDArray[np.bool_]:
    """(N,) which detections stand where a larger one stands: no two vehicles share a piece of road.

    A detection counts as a fragment where its measured point lies on the floor of the 3D box of another one whose 2D
    box is larger. Without 3D boxes there are no floors, and no fragments.
    """
    floors = found.vertices_px[:, 4:]
    starts, ends = floors[None], np.roll(floors, -1, axis=1)[None]
    ahead, to_point = ends - starts, found.feet_px[:, None, None] - starts
    side = ahead[..., 0] * to_point[..., 1] - ahead[..., 1] * to_point[..., 0]
    with np.errstate(invalid="ignore"):
        inside = (side > 0).all(axis=2) | (side < 0).all(axis=2)
    areas = _areas(found.boxes_xyxy)
    return np.asarray((inside & (areas[:, None] < areas[None])).any(axis=1))


def _areas(boxes: Array) -> Array:
    out: Array = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return out
