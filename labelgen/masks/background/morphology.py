"""Small helpers for binary pictures, (h, w) uint8 of 0 and 1."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Mask", "disc", "filled", "hull", "morph"]

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
