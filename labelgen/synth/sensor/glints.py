"""Where the sun is mirrored so brightly that the lens draws a star around it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Glints"]

_MOST, _BRIGHT = 3, 253.0
_SIZES = 4


class Glints:
    """Draws stars of one lens.

    Args:
        arm_px: length of the longest arms; below a pixel none are drawn.
        rng: decides how many arms there are and how they are turned.
    """

    def __init__(self, arm_px: float, rng: np.random.Generator) -> None:
        self._arm_px = arm_px
        arms, turn = int(rng.choice([4, 6, 8])), rng.uniform(0, np.pi)
        self._sprites = [_star(arm_px * (k + 1) / _SIZES, arms, turn) for k in range(_SIZES)] if arm_px >= 1 else []

    def add(self, image: NDArray[np.uint8], layer: Any, origin_px: tuple[int, int], hidden: NDArray[np.uint8]) -> None:
        """Draw stars over the brightest gleams of a vehicle, in place.

        Args:
            image: (H, W, 3) uint8 BGR frame.
            layer: (h, w, 4) float32 as `raster.shade` returns it.
            origin_px: (x, y) frame px of its first pixel.
            hidden: (h, w) uint8, 255 where something stands before the vehicle; (0, 0) for nothing anywhere.
        """
        if not self._sprites:
            return
        bright: Any = cv2.inRange(layer, (_BRIGHT, _BRIGHT, _BRIGHT, 0.99), (1e9, 1e9, 1e9, 1e9))
        if not cv2.countNonZero(bright):
            return
        count, _, stats, centres = cv2.connectedComponentsWithStats(bright)
        largest = 0.01 * layer.shape[0] * layer.shape[1]
        spots = [k for k in range(1, count) if 1 < stats[k, 4] < largest]
        drawn: list[NDArray[np.float64]] = []
        for k in sorted(spots, key=lambda k: -int(stats[k, 4])):
            x, y = (round(float(c)) for c in centres[k])
            near = any(np.hypot(*(centres[k] - other)) < 1.5 * self._arm_px for other in drawn)
            if near or len(drawn) == _MOST or (hidden.size and hidden[y, x] > 128):
                continue
            drawn.append(centres[k])
            size = min(_SIZES - 1, int(np.log2(stats[k, 4]) * 0.7))
            _lay(image, self._sprites[size], x + origin_px[0], y + origin_px[1])


def _star(arm_px: float, arms: int, turn: float) -> NDArray[np.uint8]:
    """A star as grey levels to be added, its middle in the middle."""
    reach = int(np.ceil(arm_px)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float64)
    far, angle = np.hypot(x, y), np.arctan2(y, x) - turn
    aside = far * np.abs(np.sin((angle * arms / 2) % np.pi)) * 2 / arms
    ray = np.exp(-((aside / 0.45) ** 2)) * np.clip(1 - far / arm_px, 0, 1) ** 1.5
    core = np.exp(-((far / max(0.18 * arm_px, 0.6)) ** 2))
    levels = 230 * np.clip(0.75 * ray + core, 0, 1)
    return np.repeat(levels.astype(np.uint8)[..., None], 3, axis=2)


def _lay(image: NDArray[np.uint8], sprite: NDArray[np.uint8], x: int, y: int) -> None:
    reach = sprite.shape[0] // 2
    x0, y0 = max(x - reach, 0), max(y - reach, 0)
    x1, y1 = min(x + reach + 1, image.shape[1]), min(y + reach + 1, image.shape[0])
    if x0 >= x1 or y0 >= y1:
        return
    part = image[y0:y1, x0:x1]
    left, top = x0 - (x - reach), y0 - (y - reach)
    part[:] = cv2.add(part, sprite[top : top + y1 - y0, left : left + x1 - x0])
