"""Small helpers for binary pictures, (h, w) uint8 of 0 and 1."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["MARGIN_PX", "Box", "Mask", "boxes_around", "disc", "filled", "hull", "morph"]

Mask = NDArray[np.uint8]


def disc(size: float) -> Mask:
    """A disc as structuring element, as wide as the next odd number of px."""
    size = max(1, int(size)) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def morph(mask: NDArray[Any], operation: int, size: float) -> Mask:
    """A morphological operation of OpenCV's with a disc."""
    return np.asarray(cv2.morphologyEx(mask, operation, disc(size)), dtype=np.uint8)


def filled(mask: Mask) -> Mask:
    """A mask with its holes filled."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return _drawn(mask, contours)


def hull(mask: Mask) -> Mask:
    """The convex hull of all that is set, filled; something must be set."""
    return _drawn(mask, [cv2.convexHull(cv2.findNonZero(mask)).reshape(-1, 1, 2)])


def _drawn(like: Mask, contours: Any) -> Mask:
    out = np.zeros_like(like)
    cv2.drawContours(out, contours, -1, 1, cv2.FILLED)
    return out


Box = tuple[slice, slice]
"""Rows and columns of a part of a picture."""


MARGIN_PX = 8
"""There are at least so many px between what a box is around and its sides, except where the frame ends."""


def boxes_around(marked: NDArray[np.uint8]) -> list[Box]:
    """Disjoint boxes that together hold all that is marked.

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
    found = _disjoint([(x, y, x + w, y + h) for x, y, w, h, _ in stats[1:].tolist()])
    return [
        (
            slice(y0 * MARGIN_PX, min(y1 * MARGIN_PX, height)),
            slice(x0 * MARGIN_PX, min(x1 * MARGIN_PX, width)),
        )
        for x0, y0, x1, y1 in found
    ]


def _disjoint(boxes: list[tuple[int, int, int, int]]) -> list[tuple[int, int, int, int]]:
    """Boxes x0, y0, x1, y1, joined until none overlaps another."""
    done: list[tuple[int, int, int, int]] = []
    while boxes:
        box = boxes.pop(0)
        hit = next(
            (b for b in done if max(b[0], box[0]) < min(b[2], box[2]) and max(b[1], box[1]) < min(b[3], box[3])), None
        )
        if hit is None:
            done.append(box)
            continue
        done.remove(hit)
        boxes.append((min(hit[0], box[0]), min(hit[1], box[1]), max(hit[2], box[2]), max(hit[3], box[3])))
    return done
