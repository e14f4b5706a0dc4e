"""Drawing lines, 3D boxes and text on pictures.

Colours are BGR; coordinates are pixels as areas, so drawing shifts by half a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

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
    "crop_around",
    "draw_arrow",
    "draw_box3d",
    "draw_label",
    "draw_polyline",
    "draw_text",
    "fit_into",
    "tile_pictures",
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


def draw_arrow(image: Picture, start: ArrayLike, towards: ArrayLike, length: float, colour: Sequence[int]) -> None:
    """Draw an arrow of a given length from a point towards another, in place."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(towards, dtype=np.float64)
    reach = np.linalg.norm(b - a)
    if not np.isfinite(reach) or reach == 0:
        return
    tip = a + (b - a) / reach * min(length, float(reach))
    p, q = (tuple(int(v) for v in np.round(point - 0.5)) for point in (a, tip))
    cv2.arrowedLine(image, p, q, tuple(colour), 1, cv2.LINE_AA, 0, 0.3)


def draw_label(
    image: Picture, box_xyxy: ArrayLike, cc: float, vpu: ArrayLike, vertices: ArrayLike | None = None
) -> None:
    """Draw a label on a rectified picture, in place: 2D box green, c_c yellow, towards VPU magenta, 3D box."""
    x0, y0, x1, y1 = (float(v) for v in np.asarray(box_xyxy, dtype=np.float64))
    if vertices is not None:
        draw_box3d(image, vertices)
    draw_polyline(image, [[x0, y0], [x1, y0], [x1, y1], [x0, y1]], GREEN, closed=True)
    y = y0 + cc * (y1 - y0)
    draw_polyline(image, [[x0, y], [x1, y]], YELLOW)
    draw_arrow(image, [(x0 + x1) / 2, (y0 + y1) / 2], vpu, 0.35 * max(x1 - x0, y1 - y0), MAGENTA)


def crop_around(image: Picture, box_xyxy: ArrayLike, margin: float, size: int) -> tuple[Picture, NDArray[np.float64]]:
    """A square cut-out around a box, scaled to (size, size); grey outside of the picture.

    Returns:
        the cut-out, and the matrix (3, 3) that maps picture px to its px.
    """
    x0, y0, x1, y1 = (float(v) for v in np.asarray(box_xyxy, dtype=np.float64))
    side = max(x1 - x0, y1 - y0, 4.0) * (1 + 2 * margin)
    gain = size / side
    matrix = np.array(
        [[gain, 0, size / 2 - gain * (x0 + x1) / 2], [0, gain, size / 2 - gain * (y0 + y1) / 2], [0, 0, 1]]
    )
    pixel = matrix.copy()
    pixel[:2, 2] += 0.5 * gain - 0.5
    how = cv2.INTER_CUBIC if gain > 1 else cv2.INTER_AREA
    cut = cv2.warpAffine(image, pixel[:2], (size, size), flags=how, borderValue=(70, 70, 70))
    return np.asarray(cut, dtype=np.uint8), matrix


def fit_into(image: Picture, size_wh: tuple[int, int]) -> Picture:
    """Scale a picture to fit a rectangle, centred on grey."""
    gain = min(size_wh[0] / image.shape[1], size_wh[1] / image.shape[0])
    w, h = max(1, round(image.shape[1] * gain)), max(1, round(image.shape[0] * gain))
    out = np.full((size_wh[1], size_wh[0], 3), 70, dtype=np.uint8)
    x, y = (size_wh[0] - w) // 2, (size_wh[1] - h) // 2
    out[y : y + h, x : x + w] = cv2.resize(
        image, (w, h), interpolation=cv2.INTER_AREA if gain < 1 else cv2.INTER_LINEAR
    )
    return out


def tile_pictures(pictures: Sequence[Any], columns: int, gap: int = 6) -> Picture:
    """One picture of many of the same size, in rows."""
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    out = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 30, dtype=np.uint8)
    for i, picture in enumerate(pictures):
        y, x = gap + (i // columns) * (height + gap), gap + (i % columns) * (width + gap)
        out[y : y + height, x : x + width] = picture
    return out
