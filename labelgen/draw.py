"""Drawing labels on pictures, cutting and tiling them; built on `labelgen.drawing`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.drawing import (
    BLUE,
    CYAN,
    GREEN,
    MAGENTA,
    RED,
    WHITE,
    YELLOW,
    Picture,
    draw_box3d,
    draw_polyline,
    draw_text,
)

__all__ = [
    "BLUE",
    "CYAN",
    "GREEN",
    "MAGENTA",
    "RED",
    "WHITE",
    "YELLOW",
    "crop_around",
    "draw_arrow",
    "draw_box3d",
    "draw_label",
    "draw_polyline",
    "draw_text",
    "fit_into",
    "tile_pictures",
]


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
