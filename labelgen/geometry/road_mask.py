"""Road masks: which pixels are road, and the convex hull around them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import RectificationError
from labelgen.geometry.homography import Array

__all__ = ["RoadMask", "binary_mask"]


def binary_mask(mask: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W) bool from a mask image (H, W) or (H, W, C): set where at least half of its type's range.

    Masks in the data are JPEG-like: neither strictly 0/255 nor free of stray values. Float masks run from 0 to 1.
    Of colour images any channel counts, but not the alpha channel that comes second or fourth.
    """
    if mask.ndim == 3 and mask.shape[2] > 0:
        mask = mask[..., : 1 if mask.shape[2] == 2 else 3].max(axis=2)
    if mask.ndim != 2:
        raise RectificationError(f"road mask: expected an image (H, W), got an array of shape {mask.shape}")
    if mask.dtype == np.bool_:
        return mask.astype(np.bool_)
    if np.issubdtype(mask.dtype, np.floating) and mask.size and np.nanmax(mask) > 1:
        raise RectificationError(
            f"road mask: expected float values from 0 to 1, got {np.nanmax(mask):g}; divide it by its greatest value"
        )
    half = (np.iinfo(mask.dtype).max + 1) / 2 if np.issubdtype(mask.dtype, np.integer) else 0.5
    return np.asarray(mask >= half)


class RoadMask:
    """A thresholded road mask with its rows' extents, so that hulls of cropped masks cost little.

    Args:
        mask: (H, W) or (H, W, C) image, thresholded at half range; any number of components.
    """

    def __init__(self, mask: NDArray[Any]) -> None:
        self.pixels = binary_mask(mask)
        self.size_wh = (self.pixels.shape[1], self.pixels.shape[0])
        self.rows = np.flatnonzero(self.pixels.any(axis=1))
        if self.rows.size == 0:
            raise RectificationError("road mask: it is empty; mark the road with values of at least half range")
        used = self.pixels[self.rows]
        self._left = used.argmax(axis=1)
        self._right = used.shape[1] - used[:, ::-1].argmax(axis=1)

    @property
    def bottom(self) -> int:
        """One past the lowest row that holds road."""
        return int(self.rows[-1]) + 1

    def hull(self, rows_below: int | None = None) -> Array:
        """Convex hull (K, 2) px of the mask's pixel areas, of the rows above `rows_below` alone if given.

        Raises:
            RectificationError: nothing of the mask is left above that row.
        """
        keep = slice(None) if rows_below is None else self.rows < rows_below
        y, left, right = self.rows[keep], self._left[keep], self._right[keep]
        if y.size == 0:
            raise RectificationError("road mask: it was cropped away before the coverage was reached")
        x = np.concatenate([left, right, left, right])
        corners = np.stack([x, np.concatenate([y, y, y + 1, y + 1])], axis=1).astype(np.int32)
        return cv2.convexHull(corners)[:, 0].astype(np.float64)

    def cropped(self, rows_below: int) -> NDArray[np.bool_]:
        """(H, W) copy with all rows from `rows_below` on cleared."""
        out = self.pixels.copy()
        out[rows_below:] = False
        return out
