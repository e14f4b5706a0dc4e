"""Axis-aligned boxes: overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from labelgen.geometry.homography import Array

__all__ = ["iou_matrix"]


def iou_matrix(first_xyxy: ArrayLike, second_xyxy: ArrayLike) -> Array:
    """(N, M) intersection over union of boxes (N, 4) with boxes (M, 4); 0 where either has no area."""
    a = np.asarray(first_xyxy, dtype=np.float64).reshape(-1, 1, 4)
    b = np.asarray(second_xyxy, dtype=np.float64).reshape(1, -1, 4)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    shared = np.maximum(sides, 0).prod(axis=-1)
    areas = [np.maximum(boxes[..., 2:] - boxes[..., :2], 0).prod(axis=-1) for boxes in (a, b)]
    union = areas[0] + areas[1] - shared
    out: Array = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    return out
