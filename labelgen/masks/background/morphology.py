"""Helpers for binary masks, (h, w) uint8 of 0 and 1, and for boxes around what is set."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["MARGIN_PX", "Box", "Mask", "disc", "disjoint_boxes", "fill_holes", "fill_hull", "morph"]

Mask = NDArray[np.uint8]
Box = tuple[slice, slice]
"""Rows and columns of a part of an image."""

MARGIN_PX = 8
"""Least distance between a marked pixel and the sides of its box, px, except at the frame's border."""


def disc(size: float) -> Mask:
    """Return a disc as structuring element, its diameter the next odd number of px from `size` on."""
    size = max(1, int(size)) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def morph(mask: NDArray[Any], operation: int, size: float) -> Mask:
    """Apply one of OpenCV's morphological operations (`cv2.MORPH_...`) with a disc of this diameter, px."""
    return np.asarray(cv2.morphologyEx(mask, operation, disc(size)), dtype=np.uint8)


def fill_holes(mask: Mask) -> Mask:
    """Return a mask (h, w) with its holes filled."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return _fill_contours(mask, contours)


def fill_hull(mask: Mask) -> Mask:
    """Return the filled convex hull of a mask (h, w) with at least one pixel set."""
    return _fill_contours(mask, [cv2.convexHull(cv2.findNonZero(mask)).reshape(-1, 1, 2)])


def _fill_contours(like: Mask, contours: Any) -> Mask:
    out = np.zeros_like(like)
    cv2.drawContours(out, contours, -1, 1, cv2.FILLED)
    return out


def disjoint_boxes(marked: NDArray[np.uint8]) -> list[Box]:
    """Return disjoint boxes that together hold all marked pixels, each with a margin of `MARGIN_PX`.

    Args:
        marked: (H, W, C) uint8; a pixel is marked where one of its channels is not 0.
    """
    height, width, channels = marked.shape
    rows = marked.reshape(height, width * channels)
    whole = height // MARGIN_PX * MARGIN_PX
    tiles = rows[:whole].reshape(-1, MARGIN_PX, width * channels).max(axis=1)
    if whole < height:
        tiles = np.concatenate([tiles, rows[whole:].max(axis=0)[None]])
    tiles = np.maximum.reduceat(tiles, np.arange(0, width * channels, MARGIN_PX * channels), axis=1)
    if not tiles.any():
        return []
    near = cv2.dilate((tiles > 0).view(np.uint8), np.ones((3, 3), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(near)
    tile_boxes = _merge_overlapping([(x, y, x + w, y + h) for x, y, w, h, _ in stats[1:].tolist()])
    return [
        (
            slice(y0 * MARGIN_PX, min(y1 * MARGIN_PX, height)),
            slice(x0 * MARGIN_PX, min(x1 * MARGIN_PX, width)),
        )
        for x0, y0, x1, y1 in tile_boxes
    ]


def _merge_overlapping(boxes: list[tuple[int, int, int, int]]) -> list[tuple[int, int, int, int]]:
    """Join boxes x0, y0, x1, y1 until none overlaps another."""
    disjoint: list[tuple[int, int, int, int]] = []
    while boxes:
        box = boxes.pop(0)
        overlapping = next(
            (
                other
                for other in disjoint
                if max(other[0], box[0]) < min(other[2], box[2]) and max(other[1], box[1]) < min(other[3], box[3])
            ),
            None,
        )
        if overlapping is None:
            disjoint.append(box)
            continue
        disjoint.remove(overlapping)
        (x0, y0, x1, y1), (u0, v0, u1, v1) = overlapping, box
        boxes.append((min(x0, u0), min(y0, v0), max(x1, u1), max(y1, v1)))
    return disjoint
