"""Background image of a fixed camera: the median over a few frames that are kept compressed."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.sorting_network import sort_samples

__all__ = ["BackgroundImageEstimator", "BackgroundImageSettings"]

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class BackgroundImageSettings:
    """How the background image is estimated."""

    max_frames: int = 40
    """Frames kept from the beginning of the video; more cost memory, and traffic repeats itself."""
    max_samples: int = 15
    """At most so many of the kept frames enter the median; more cost time, fewer leave slow vehicles in the image."""
    band_rows: int = 16
    """Rows of the image sorted at once; larger bands leave the processor's cache."""
    jpeg_quality: int = 95
    """Of the kept frames; a lower one saves memory and shows in the image."""


class BackgroundImageEstimator:
    """Estimate the empty scene of a fixed camera from a few full-size frames.

    Args:
        settings: thresholds.
    """

    def __init__(self, settings: BackgroundImageSettings | None = None) -> None:
        self._settings = settings or BackgroundImageSettings()
        self._jpegs: list[Image] = []

    def update(self, image: Image) -> None:
        """Take a frame, (H, W, 3) uint8 BGR; frames after the first `max_frames` are ignored."""
        if len(self._jpegs) < self._settings.max_frames:
            quality = [cv2.IMWRITE_JPEG_QUALITY, self._settings.jpeg_quality]
            self._jpegs.append(np.asarray(cv2.imencode(".jpg", image, quality)[1], dtype=np.uint8))

    def median_image(self) -> Image | None:
        """Return the background (H, W, 3) uint8 BGR, a median per pixel and channel; None without any frame."""
        count = len(self._jpegs)
        if not count:
            return None
        samples = self._jpegs[:: max(1, -(-count // self._settings.max_samples))]
        stack = np.stack([np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8) for jpeg in samples])
        out = np.empty(stack.shape[1:], dtype=np.uint8)
        band = self._settings.band_rows
        for row in range(0, len(out), band):
            out[row : row + band] = sort_samples(stack[:, row : row + band])[len(samples) // 2]
        return out
