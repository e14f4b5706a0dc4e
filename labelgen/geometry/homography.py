"""Homogeneous points, lines and homographies, batched over leading axes.

Convention:
    float64. Points are (..., 2) as x, y; homographies (..., 3, 3) act on column vectors (x, y, 1); lines are (3,) as
    a, b, c with a x + b y + c = 0; boxes are (..., 4) as x0, y0, x1, y1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Array", "IntArray", "apply_homography", "bounding_boxes", "clip_polygon", "homogeneous", "translation"]

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def homogeneous(points: ArrayLike) -> Array:
    """Append a 1 to the last axis: (..., D) -> (..., D + 1)."""
    pts = np.asarray(points, dtype=np.float64)
    return np.concatenate([pts, np.ones((*pts.shape[:-1], 1))], axis=-1)


def translation(dx: float, dy: float) -> Array:
    """Return the matrix (3, 3) that moves points by (dx, dy)."""
    return np.array([[1.0, 0.0, dx], [0.0, 1.0, dy], [0.0, 0.0, 1.0]])


def apply_homography(matrix: Array, points: ArrayLike, *, behind: str = "nan") -> Array:
    """Map points by homographies.

    Args:
        matrix: (..., 3, 3), signed so that visible points get a positive third coordinate.
        points: (..., K, 2); leading axes broadcast against those of `matrix`.
        behind: "nan" gives NaN for points on or beyond the line that maps to infinity; "keep" maps them as well, as
            vanishing points need.

    Returns:
        (..., K, 2).
    """
    mapped = homogeneous(points) @ np.swapaxes(matrix, -1, -2)
    w = mapped[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        out: Array = mapped[..., :2] / (w if behind == "keep" else np.where(w > 0, w, np.nan))
    return out


def bounding_boxes(points: ArrayLike) -> Array:
    """Return the axis-aligned boxes (..., 4) around point sets (..., K, 2)."""
    pts = np.asarray(points, dtype=np.float64)
    return np.concatenate([pts.min(axis=-2), pts.max(axis=-2)], axis=-1)


def clip_polygon(polygon: Array, line: Array) -> Array:
    """Return the part (J, 2) of a convex polygon (K, 2) where a x + b y + c >= 0 for a line (3,); J may be 0."""
    side = homogeneous(polygon) @ line
    if (side >= 0).all():
        return polygon
    corners = []
    for i in range(len(polygon)):
        if side[i - 1] * side[i] < 0:
            corners.append(polygon[i - 1] + (polygon[i] - polygon[i - 1]) * side[i - 1] / (side[i - 1] - side[i]))
        if side[i] >= 0:
            corners.append(polygon[i])
    return np.array(corners).reshape(-1, 2)
