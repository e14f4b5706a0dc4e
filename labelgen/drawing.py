"""Drawing lines, 3D boxes and text on pictures.

Colours are BGR; coordinates are pixels as areas, so drawing shifts by half a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "BLUE",
    "CYAN",
    "GREEN",
    "MAGENTA",
    "RED",
    "WHITE",
    "YELLOW",
    "Picture",
    "draw_box3d",
    "draw_polyline",
    "draw_text",
]

Picture = NDArray[np.uint8]
GREEN, YELLOW, MAGENTA, RED, BLUE, CYAN, WHITE = (
    (80, 220, 80), (0, 230, 255), (255, 60, 255), (60, 60, 255), (255, 140, 40), (255, 230, 60), (255, 255, 255),
)  # fmt: skip

_FRONT, _REAR = (0, 1, 5, 4), (3, 2, 6, 7)
_SHIFT = 4
_CLIP = 30000.0


def _fixed(points: ArrayLike) -> NDArray[np.int32]:
    """Fixed-point coordinates for OpenCV, clipped to what its drawing can hold."""
    pts = np.clip(np.asarray(points, dtype=np.float64) - 0.5, -_CLIP, _CLIP)
    return np.asarray(np.round(pts * 2**_SHIFT), dtype=np.int32)


def draw_polyline(
    image: Picture, points: ArrayLike, colour: Sequence[int], thickness: int = 1, *, closed: bool = False
) -> None:
    """Draw a line through points (K, 2), in place; nothing where one is not finite."""
    pts = np.asarray(points, dtype=np.float64)
    if np.isfinite(pts).all():
        cv2.polylines(image, [_fixed(pts)[:, None]], closed, tuple(colour), thickness, cv2.LINE_AA, _SHIFT)


def draw_box3d(image: Picture, vertices: ArrayLike, thickness: int = 1) -> None:
    """Draw a 3D box (8, 2), in place: front face red, rear face and edges between them blue."""
    pts = np.asarray(vertices, dtype=np.float64)
    if not np.isfinite(pts).all():
        return
    for a, b in zip(_FRONT, _REAR, strict=True):
        draw_polyline(image, pts[[a, b]], BLUE, thickness)
    draw_polyline(image, pts[list(_REAR)], BLUE, thickness, closed=True)
    draw_polyline(image, pts[list(_FRONT)], RED, thickness, closed=True)


def draw_text(
    image: Picture, text: str, origin: tuple[int, int], scale: float = 0.4, colour: Sequence[int] = WHITE
) -> None:
    """Write ASCII text on a dark ground, in place; `origin` is its lower left corner."""
    if not text:
        return
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    x, y = origin
    top, left = max(0, y - height - 3), max(0, x - 3)
    ground = image[top : y + 5, left : x + width + 3]
    ground[:] = ground // 3
    cv2.putText(image, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, tuple(colour), 1, cv2.LINE_AA)
