"""Road masks: which pixels are road, and the convex hull around them.

Convention:
    Masks are (H, W) bool, one value a pixel of the frame; pixel (column j, row i) covers [j, j + 1) x [i, i + 1), so
    that hulls, (K, 2) float64 px as x, y, run along pixel borders.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import RectificationError
from labelgen.geometry.frame_size import scale_between, size_text
from labelgen.geometry.homography import Array

__all__ = ["RoadMask", "binary_mask", "fit_mask"]


def binary_mask(mask: NDArray[Any]) -> NDArray[np.bool_]:
    """Threshold a mask image at half of its type's range.

    Masks of the data sets come from lossy images: values other than 0 and 255 occur. Of colour images the greatest
    channel counts; the alpha channel, second or fourth, does not.

    Args:
        mask: (H, W) or (H, W, C), of any integer type, bool, or float in [0, 1].

    Returns:
        (H, W) bool.

    Raises:
        RectificationError: another shape, or float values above 1.
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


def fit_mask(mask: NDArray[np.bool_], image_wh: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a road mask (H, W) bool for frames of a size (width, height) px: resized where it is of another size.

    Raises:
        RectificationError: it is of frames of another ratio.
    """
    own = (mask.shape[1], mask.shape[0])
    if own == tuple(image_wh):
        return mask
    if not mask.size or scale_between(own, image_wh) is None:
        raise RectificationError(
            f"road mask: it is {size_text(own)} px, but the frames are {size_text(image_wh)}, which is not the same "
            "ratio; give a mask of the frames' size",
            parameter="road_mask",
        )
    shrinks = own[0] > image_wh[0]
    grey = cv2.resize(
        mask.astype(np.uint8) * 255, image_wh, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    return np.asarray(grey >= 128)


class RoadMask:
    """A thresholded road mask that keeps the extent of each row, so that hulls of cropped masks cost little.

    Args:
        mask: (H, W) or (H, W, C) image, thresholded by `binary_mask`; any number of components.

    Attributes:
        pixels: (H, W) bool, True on the road.
        size_wh: width and height, px.
        rows: (R,) int64, the rows that hold road, ascending.

    Raises:
        RectificationError: no pixel is road, or the mask is no image.
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
        """Number of the row below the lowest one that holds road."""
        return int(self.rows[-1]) + 1

    def hull(self, rows_below: int | None = None) -> Array:
        """Return the convex hull (K, 2), px, of the mask's pixel areas.

        Args:
            rows_below: the first row that is left out; None to use all rows.

        Raises:
            RectificationError: no row above it holds road.
        """
        keep = slice(None) if rows_below is None else self.rows < rows_below
        y, left, right = self.rows[keep], self._left[keep], self._right[keep]
        if y.size == 0:
            raise RectificationError("road mask: it was cropped away before the coverage was reached")
        x = np.concatenate([left, right, left, right])
        corners = np.stack([x, np.concatenate([y, y, y + 1, y + 1])], axis=1).astype(np.int32)
        return cv2.convexHull(corners)[:, 0].astype(np.float64)

    def cropped(self, rows_below: int) -> NDArray[np.bool_]:
        """Return a copy (H, W) bool of the mask, all rows from `rows_below` on cleared."""
        out = self.pixels.copy()
        out[rows_below:] = False
        return out
