"""Sensor noise whose strength depends on brightness."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["NoiseModel"]

_SPREAD = 24.0
"""Standard deviation of the noise that a tile stores; it is scaled when it is added."""
_MARGIN = 128
"""By how many px a tile is larger than a frame."""
_FIXED = 4096
"""One in the fixed-point arithmetic of `_add`."""


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations of noise, grey levels, at brightnesses spread evenly from 0 to 255.

    Args:
        grey: of brightness.
        colour: of each of the two chroma planes.
        grey_px, colour_px: sigma of the blur that correlates neighbouring pixels, px.
        on_vehicles: shares of both that vehicles show, likewise by brightness: codecs smooth moving parts more.
    """

    grey: tuple[float, ...]
    colour: tuple[float, ...]
    grey_px: float
    colour_px: float
    on_vehicles: tuple[float, ...] = (1.0,)

    def tile(self, size_wh: tuple[int, int], rng: np.random.Generator) -> NDArray[np.int8]:
        """Return a tile of noise, larger than a frame so that each frame uses another part of it.

        Args:
            size_wh: frame size in px.
            rng: gives the noise.

        Returns:
            (H + 128, W + 128, 3) int8: brightness and two chroma planes.
        """
        shape = (size_wh[1] + _MARGIN, size_wh[0] + _MARGIN)
        out = np.empty((*shape, 3), dtype=np.int8)
        for k, sigma in enumerate((self.grey_px, self.colour_px, self.colour_px)):
            plane = rng.normal(size=shape).astype(np.float32)
            if sigma > 0.15:
                plane = np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma), dtype=np.float32)
            out[..., k] = (_SPREAD * plane / plane.std()).round().clip(-127, 127)
        return out

    def add(
        self, image: NDArray[np.uint8], tile: NDArray[np.int8], number: int, vehicles: NDArray[np.bool_] | None = None
    ) -> None:
        """Add noise to a frame (H, W, 3) uint8 BGR, in place.

        Args:
            image: the frame.
            tile: from `tile`.
            number: of the frame; selects the part of the tile.
            vehicles: (H, W) bool, where vehicles are; nowhere when None.
        """
        height, width = image.shape[:2]
        dx, dy = np.random.default_rng([number, 5]).integers(0, _MARGIN, 2).tolist()
        steps = np.linspace(0, 255, len(self.grey))
        shares = np.interp(np.arange(256), np.linspace(0, 255, len(self.on_vehicles)), self.on_vehicles)
        tables = [np.interp(np.arange(256), steps, part) * _FIXED / _SPREAD for part in (self.grey, self.colour)]
        grey, colour = (np.stack([t, t * shares]).round().astype(np.int32) for t in tables)
        where = np.zeros((height, width), dtype=np.bool_) if vehicles is None else vehicles
        _add(image, tile[dy : dy + height, dx : dx + width], where, grey, colour)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(
    image: NDArray[np.uint8], noise: NDArray[np.int8], vehicles: NDArray[np.bool_], grey: NDArray[np.int32],
    colour: NDArray[np.int32],
) -> None:  # fmt: skip
    for r in range(image.shape[0]):
        for c in range(image.shape[1]):
            b, g, d = np.int32(image[r, c, 0]), np.int32(image[r, c, 1]), np.int32(image[r, c, 2])
            level = (29 * b + 150 * g + 77 * d) >> 8
            kind = np.int32(vehicles[r, c])
            strength = colour[kind, level]
            bright = noise[r, c, 0] * grey[kind, level]
            red, blue = noise[r, c, 1] * strength, noise[r, c, 2] * strength
            # YCbCr back to BGR in fixed point; 2048 is one half, for rounding.
            b += (bright + 1.77 * blue + 2048) // 4096
            g += (bright - 0.71 * red - 0.34 * blue + 2048) // 4096
            d += (bright + 1.40 * red + 2048) // 4096
            image[r, c, 0] = min(max(b, 0), 255)
            image[r, c, 1] = min(max(g, 0), 255)
            image[r, c, 2] = min(max(d, 0), 255)
