"""The encoding of rectified images in shards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError

__all__ = ["ImageCodec"]


@dataclass(frozen=True)
class ImageCodec:
    """JPEG of a quality, or PNG.

    Args:
        quality: JPEG quality from 1 to 100; None for lossless PNG.

    Raises:
        LabelgenError: a quality outside of this range.
    """

    quality: int | None = 95

    def __post_init__(self) -> None:
        if self.quality is not None and not 1 <= self.quality <= 100:
            raise LabelgenError(f"quality {self.quality}: expected 1 to 100", parameter="quality")

    def describe(self) -> dict[str, Any]:
        """Return the codec as entries of the shards' settings."""
        return {"image": "png" if self.quality is None else "jpeg", "quality": self.quality}

    def encode(self, image: NDArray[np.uint8]) -> bytes:
        """Encode an image.

        Args:
            image: (H, W, 3) uint8 BGR.

        Raises:
            LabelgenError: an array that cannot be encoded.
        """
        if self.quality is None:
            ok, data = cv2.imencode(".png", image)
        else:
            ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        if not ok:
            raise LabelgenError(f"an image of shape {image.shape} cannot be encoded")
        return data.tobytes()
