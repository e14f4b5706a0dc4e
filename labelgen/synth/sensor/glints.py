"""Stars that a lens draws around bright reflections of the sun."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["GLINTS", "GlintThresholds", "Glints"]


@dataclass(frozen=True)
class GlintThresholds:
    """Which reflections get a star.

    Args:
        max_stars: stars per vehicle.
        bright_levels: grey level of all channels from which a pixel is a reflection of the sun.
        sizes: number of sizes of stars.
        max_area: area of a reflection, as a share of the vehicle's window, above which it is a bright panel.
        spacing: least distance of two stars, in lengths of their arms.
    """

    max_stars: int = 3
    bright_levels: float = 253.0
    sizes: int = 4
    max_area: float = 0.01
    spacing: float = 1.5


GLINTS = GlintThresholds()


class Glints:
    """Draw the stars of one lens.

    Args:
        arm_px: length of the longest arms; below one pixel no stars are drawn.
        rng: gives the number of arms and their angle.
        thresholds: which reflections get a star.
    """

    def __init__(self, arm_px: float, rng: np.random.Generator, thresholds: GlintThresholds = GLINTS) -> None:
        self._arm_px = arm_px
        self._thresholds = thresholds
        sizes = thresholds.sizes
        arms, turn = int(rng.choice([4, 6, 8])), rng.uniform(0, np.pi)
        self._sprites = [_star(arm_px * (k + 1) / sizes, arms, turn) for k in range(sizes)] if arm_px >= 1 else []

    def add(self, image: NDArray[np.uint8], layer: Any, origin_px: tuple[int, int], hidden: NDArray[np.uint8]) -> None:
        """Draw stars over the brightest reflections of a vehicle, in place.

        Args:
            image: (H, W, 3) uint8 BGR frame.
            layer: (h, w, 4) float32, from `rasterizer.shade`.
            origin_px: (x, y) frame px of its first pixel.
            hidden: (h, w) uint8, 255 where something stands in front of the vehicle; (0, 0) for nowhere.
        """
        if not self._sprites:
            return
        level = self._thresholds.bright_levels
        bright: Any = cv2.inRange(layer, (level, level, level, 0.99), (1e9, 1e9, 1e9, 1e9))
        if not cv2.countNonZero(bright):
            return
        count, _, stats, centres = cv2.connectedComponentsWithStats(bright)
        largest = self._thresholds.max_area * layer.shape[0] * layer.shape[1]
        spots = [k for k in range(1, count) if 1 < stats[k, 4] < largest]
        drawn: list[NDArray[np.float64]] = []
        for k in sorted(spots, key=lambda k: -int(stats[k, 4])):
            x, y = (round(float(c)) for c in centres[k])
            near = any(np.hypot(*(centres[k] - other)) < self._thresholds.spacing * self._arm_px for other in drawn)
            if near or len(drawn) == self._thresholds.max_stars or (hidden.size and hidden[y, x] > 128):
                continue
            drawn.append(centres[k])
            size = min(self._thresholds.sizes - 1, int(np.log2(stats[k, 4]) * 0.7))
            _lay(image, self._sprites[size], x + origin_px[0], y + origin_px[1])


def _star(arm_px: float, arms: int, turn: float) -> NDArray[np.uint8]:
    """Return a star (2 r + 1, 2 r + 1, 3) as grey levels to be added, centred."""
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
