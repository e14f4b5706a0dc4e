"""Drawing lines, 3D boxes, labels and text on pictures, and arranging pictures.

Convention:
    Pictures are (H, W, 3) uint8 BGR and drawn on in place. Points are (..., 2) px as x, y, x right, y down, pixels
    being areas; OpenCV's coordinates are those of pixel centres, half a pixel less.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "BLUE",
    "CYAN",
    "GREEN",
    "GREY",
    "MAGENTA",
    "RED",
    "WHITE",
    "YELLOW",
    "Picture",
    "crop_around",
    "draw_arrow",
    "draw_box3d",
    "draw_dashed_box",
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
GREY = (170, 170, 170)

_FRONT, _REAR = (0, 1, 5, 4), (3, 2, 6, 7)
_SHIFT = 4
_CLIP = 30000.0


def _fixed(points: ArrayLike) -> NDArray[np.int32]:
    """Return fixed-point coordinates for OpenCV, clipped to the range that its drawing functions support."""
    pts = np.clip(np.asarray(points, dtype=np.float64) - 0.5, -_CLIP, _CLIP)
    return np.asarray(np.round(pts * 2**_SHIFT), dtype=np.int32)


def draw_polyline(
    image: Picture, points: ArrayLike, colour: Sequence[int], thickness: int = 1, *, closed: bool = False
) -> None:
    """Draw a line through points (K, 2), px; nothing where a point is not finite."""
    pts = np.asarray(points, dtype=np.float64)
    if np.isfinite(pts).all():
        cv2.polylines(image, [_fixed(pts)[:, None]], closed, tuple(colour), thickness, cv2.LINE_AA, _SHIFT)


def draw_box3d(image: Picture, vertices: ArrayLike, thickness: int = 1) -> None:
    """Draw a 3D box (8, 2), px: front face red, rear face and the edges between them blue."""
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
    """Write ASCII text on a dark ground; `origin` is its lower left corner, px."""
    if not text:
        return
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    x, y = origin
    top, left = max(0, y - height - 3), max(0, x - 3)
    ground = image[top : y + 5, left : x + width + 3]
    ground[:] = ground // 3
    cv2.putText(image, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, tuple(colour), 1, cv2.LINE_AA)


def draw_arrow(image: Picture, start: ArrayLike, towards: ArrayLike, length: float, colour: Sequence[int]) -> None:
    """Draw an arrow from a point (2,) towards another one, with at most the given length, px."""
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
    """Draw a label on a rectified picture: 2D box green, c_c yellow, direction of VPU magenta, 3D box.

    Args:
        image: the rectified picture.
        box_xyxy: (4,) px.
        cc: c_c in [0, 1].
        vpu: (2,) px.
        vertices: (8, 2) px of the 3D box; None to leave it out.
    """
    x0, y0, x1, y1 = (float(v) for v in np.asarray(box_xyxy, dtype=np.float64))
    if vertices is not None:
        draw_box3d(image, vertices)
    draw_polyline(image, [[x0, y0], [x1, y0], [x1, y1], [x0, y1]], GREEN, closed=True)
    y = y0 + cc * (y1 - y0)
    draw_polyline(image, [[x0, y], [x1, y]], YELLOW)
    draw_arrow(image, [(x0 + x1) / 2, (y0 + y1) / 2], vpu, 0.35 * max(x1 - x0, y1 - y0), MAGENTA)


def draw_dashed_box(
    image: Picture, box_xyxy: ArrayLike, text: str = "", colour: Sequence[int] = GREY, dash_px: float = 4.0
) -> None:
    """Draw a 2D box (4,), px, as dashes of a length in px with gaps as long, and a text above it."""
    x0, y0, x1, y1 = (float(v) for v in np.asarray(box_xyxy, dtype=np.float64))
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    # Cut near the picture: a box far beyond it would take very many dashes.
    corners = np.clip(corners, -2 * dash_px, np.array(image.shape[1::-1]) + 2 * dash_px)
    for start, end in itertools.pairwise(corners):
        steps = max(1, int(np.linalg.norm(end - start) / dash_px))
        points = np.linspace(start, end, steps + 1)
        for i in range(0, steps, 2):
            draw_polyline(image, points[i : i + 2], colour)
    draw_text(image, text, (int(corners[0, 0]), max(10, int(corners[0, 1]) - 3)), 0.33, colour)


def crop_around(image: Picture, box_xyxy: ArrayLike, margin: float, size: int) -> tuple[Picture, NDArray[np.float64]]:
    """Crop a square around a box and scale it.

    Args:
        image: the picture.
        box_xyxy: (4,) px.
        margin: added on each side, as a share of the box's larger side.
        size: width and height of the result, px.

    Returns:
        The crop (size, size, 3), grey outside the picture, and the matrix (3, 3) from picture px to crop px.
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
    """Scale a picture to fit a size (width, height), px, centred on grey (letterbox)."""
    gain = min(size_wh[0] / image.shape[1], size_wh[1] / image.shape[0])
    w, h = max(1, round(image.shape[1] * gain)), max(1, round(image.shape[0] * gain))
    out = np.full((size_wh[1], size_wh[0], 3), 70, dtype=np.uint8)
    x, y = (size_wh[0] - w) // 2, (size_wh[1] - h) // 2
    out[y : y + h, x : x + w] = cv2.resize(
        image, (w, h), interpolation=cv2.INTER_AREA if gain < 1 else cv2.INTER_LINEAR
    )
    return out


def tile_pictures(pictures: Sequence[Any], columns: int, gap: int = 6) -> Picture:
    """Arrange pictures of one size in rows of so many columns, with a gap in px between them."""
    height, width = pictures[0].shape[:2]
    rows = -(-len(pictures) // columns)
    out = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 30, dtype=np.uint8)
    for i, picture in enumerate(pictures):
        y, x = gap + (i // columns) * (height + gap), gap + (i % columns) * (width + gap)
        out[y : y + height, x : x + width] = picture
    return out
