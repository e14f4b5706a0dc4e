"""Where a window of a frame lies in the picture that a network sees.

Convention: pixels are areas; a point (x, y) of the frame lies at (x, y) * scale + offset in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Placement", "Window", "letterbox", "stretch"]

Window = tuple[int, int, int, int]
"""x0, y0, x1, y1 of a part of the frame, px."""

# Grey around a letterboxed picture, as YOLO networks are trained with.
_PAD_VALUE = 114


@dataclass(frozen=True)
class Placement:
    """A window of the frame, resized and put into a picture.

    Args:
        window: part of the frame, px.
        inner: x, y, width, height of the resized window in the picture, px.
        picture_wh: size of the picture, px.
    """

    window: Window
    inner: tuple[int, int, int, int]
    picture_wh: tuple[int, int]

    @property
    def scale(self) -> NDArray[np.float64]:
        """(2,) px of the picture a px of the frame."""
        x0, y0, x1, y1 = self.window
        return np.array([self.inner[2] / (x1 - x0), self.inner[3] / (y1 - y0)])

    @property
    def offset(self) -> NDArray[np.float64]:
        """(2,) px of the picture, where the frame's origin lies."""
        return np.array(self.inner[:2], dtype=np.float64) - np.array(self.window[:2]) * self.scale

    def boxes_to_frame(self, boxes_xyxy: NDArray[Any]) -> NDArray[np.float64]:
        """Return boxes (N, 4) of the picture in px of the frame."""
        points = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 2, 2)
        return ((points - self.offset) / self.scale).reshape(-1, 4)

    def picture(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) uint8 of a frame (H, W, 3) uint8, in the frame's order of channels."""
        x0, y0, x1, y1 = self.window
        x, y, width, height = self.inner
        part = image[y0:y1, x0:x1]
        if (width, height) != (x1 - x0, y1 - y0):
            part = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        if (width, height) == self.picture_wh:
            return part
        out = np.full((self.picture_wh[1], self.picture_wh[0], 3), _PAD_VALUE, dtype=np.uint8)
        out[y : y + height, x : x + width] = part
        return out


def letterbox(window: Window, picture_wh: tuple[int, int]) -> Placement:
    """Return a window resized in its own ratio to fit a picture, in its middle."""
    width, height = window[2] - window[0], window[3] - window[1]
    scale = min(picture_wh[0] / width, picture_wh[1] / height)
    inner_wh = max(1, round(width * scale)), max(1, round(height * scale))
    # The odd pixel of the border goes to the right and below.
    x, y = (picture_wh[0] - inner_wh[0]) // 2, (picture_wh[1] - inner_wh[1]) // 2
    return Placement(window, (x, y, *inner_wh), picture_wh)


def stretch(window: Window, picture_wh: tuple[int, int]) -> Placement:
    """Return a window resized to a whole picture, whatever its ratio."""
    return Placement(window, (0, 0, *picture_wh), picture_wh)
