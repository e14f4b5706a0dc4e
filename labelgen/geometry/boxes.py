"""Axis-aligned boxes: overlap, and which of them the image's border cuts.

Convention:
    Boxes are (..., 4) float64 as x0, y0, x1, y1 in px, pixels being areas; x points right, y down.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from labelgen.geometry.homography import Array

__all__ = ["CUT_MARGIN_PX", "covered_share", "iou_matrix"]

CUT_MARGIN_PX = 3.0
"""A box that ends less than this above the image's lower border counts as cut by it, px.

It covers the error of a detected side: less takes cut vehicles for whole ones, more loses whole ones near the camera.
"""


def iou_matrix(first_xyxy: ArrayLike, second_xyxy: ArrayLike) -> Array:
    """Return the intersection over union of each of N boxes with each of M others.

    Args:
        first_xyxy: (N, 4) px.
        second_xyxy: (M, 4) px.

    Returns:
        (N, M) in [0, 1]; 0 where neither box has an area.
    """
    intersection, first, second = _areas(first_xyxy, second_xyxy)
    union = first + second - intersection
    out: Array = np.divide(intersection, union, out=np.zeros_like(intersection), where=union > 0)
    return out


def covered_share(first_xyxy: ArrayLike, second_xyxy: ArrayLike) -> Array:
    """Return the share of the area of each of N boxes that each of M others covers.

    Args:
        first_xyxy: (N, 4) px.
        second_xyxy: (M, 4) px.

    Returns:
        (N, M) in [0, 1]; 0 for a box without an area.
    """
    intersection, first, _ = _areas(first_xyxy, second_xyxy)
    first = np.broadcast_to(first, intersection.shape)
    out: Array = np.divide(intersection, first, out=np.zeros_like(intersection), where=first > 0)
    return out


def _areas(first_xyxy: ArrayLike, second_xyxy: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the areas (N, M) common to boxes, and those of the boxes themselves, (N, 1) and (1, M)."""
    a = np.asarray(first_xyxy, dtype=np.float64).reshape(-1, 1, 4)
    b = np.asarray(second_xyxy, dtype=np.float64).reshape(1, -1, 4)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    first, second = (np.maximum(boxes[..., 2:] - boxes[..., :2], 0).prod(axis=-1) for boxes in (a, b))
    return np.maximum(sides, 0).prod(axis=-1), first, second
