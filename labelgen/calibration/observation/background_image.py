"""The empty scene, from frames kept compressed while they go by."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.sorting_network import sort_samples

__all__ = ["Backdrop"]

Image = NDArray[np.uint8]
_KEPT, _SAMPLES = 40, 15
_BAND = 16
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]


class Backdrop:
    """Empty scene of a fixed camera from a few looks per second, (H, W, 3) full-size BGR."""

    def __init__(self) -> None:
        self._kept: list[Image] = []

    def look(self, image: Image) -> None:
        """Take a frame."""
        if len(self._kept) < _KEPT:
            self._kept.append(np.asarray(cv2.imencode(".jpg", image, _QUALITY)[1], dtype=np.uint8))

    def picture(self) -> Image | None:
        """(H, W, 3) BGR, the empty scene: the median over the early looks; None without any."""
        count = len(self._kept)
        if not count:
            return None
        chosen = self._kept[:: max(1, -(-count // _SAMPLES))]
        stack = np.stack([np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8) for packed in chosen])
        out = np.empty(stack.shape[1:], dtype=np.uint8)
        for row in range(0, len(out), _BAND):
            out[row : row + _BAND] = sort_samples(stack[:, row : row + _BAND])[len(chosen) // 2]
        return out
