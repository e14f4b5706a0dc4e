"""What the empty scene looks like, pixel by pixel, how much it flickers, and how dark its shadows are.

The model starts as the most frequent colour of each pixel over the beginning of a video, which survives dense traffic
better than the median, and then follows the light by one grey level at a time (the sigma-delta filter of Manzanera &
Richefeu 2007, which tracks the median), nowhere near a vehicle. What stands still for long becomes background; what
the model shows and the scene has lost ("ghosts") is dropped at once. Images are first moved onto the model: bridges and
masts sway.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.morphology import Box, boxes_around
from labelgen.masks.background.sorting_network import in_order

__all__ = ["BackgroundModel", "Difference", "is_ghost", "lightness", "slope", "stain"]

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]
BoolMask = NDArray[np.bool_]

_SAMPLES = 64
# Half of what is seen of a pixel may be vehicles: the mode is sought in the densest 40 % of the samples.
_MODE_SHARE = 0.4
# So many rows of all samples together are at hand for the processor.
_BAND = 16
_NOISE_RANGE = (1.5, 12.0)
# A pixel has changed from this difference on: in grey levels, in multiples of the pixel's flicker, and in pixels of
# sway that moving the images has not undone; a camera that sways does so by more than a fixed one.
_CHANGE_LEVELS = 12.0
_CHANGE_SIGMAS = 4.0
_SWAY_PX = {False: 0.05, True: 0.3}
# A shift between image and model is believed if the correlation peak is this clear and the shift of this size, px.
_SHIFT_RESPONSE = 0.4
_SHIFT_RANGE = (0.7, 24.0)
# Observations of standing still until a ghost, and until anything, becomes background.
_STILL_GHOST = 8
_STILL_FOREVER = 120
_STILL_LEVELS = 8
_TYPICAL_SHADOW = 0.55
# Differences in whole grey levels, between rounded pictures, are off by at most this.
_ROUNDING_LEVELS = 2
_GAINS = (0.7, 1.4)


@dataclass(frozen=True, eq=False)
class Difference:
    """A part of an image in which it may differ from the empty scene; elsewhere it does not.

    Args:
        box: where the part lies.
        open_sides: whether the frame goes on above, below, to the left and to the right of it; if so it does not
            differ within `labelgen.masks.background.morphology.MARGIN_PX` of that side.
        smooth: (h, w, 3) float32, the image, slightly smoothed.
        expected: (h, w, 3) float32, the empty scene, as smooth, at the exposure of the image.
        amount: (h, w) float32 by how much they differ, grey levels.
        threshold: (h, w) float32, what neither flicker nor sway explains.
    """

    box: Box
    open_sides: tuple[bool, bool, bool, bool]
    smooth: Plane
    expected: Plane
    amount: Plane
    threshold: Plane


@dataclass(frozen=True, eq=False)
class _Reference:
    """The empty scene as images are compared with it.

    Args:
        smooth: (H, W, 3) float32, slightly smoothed.
        levels: the same in whole grey levels.
        quiet: (H, W, 3) uint8, differences in whole grey levels up to which nothing has changed for sure.
        sample: (3, N) float32, some of the background's pixels.
    """

    smooth: Plane
    levels: Image
    quiet: Image
    sample: Plane


class BackgroundModel:
    """The empty scene of a fixed camera. Images are (H, W, 3) uint8 BGR, all of one size.

    Attributes:
        background: (H, W, 3) float32 BGR; None before the first image.
        shadow: how bright a flat cast shadow typically is, relative to the ground without it.
    """

    def __init__(self) -> None:
        self.background: Plane | None = None
        self.shadow = _TYPICAL_SHADOW
        self._noise: Plane | None = None
        self._edges: Plane | None = None
        self._previous: Image | None = None
        self._still: NDArray[np.uint8] | None = None
        self._observed = 0
        self._sways = False
        self._reference: _Reference | None = None

    def prime(self, images: Iterable[Image]) -> None:
        """Learn the scene from the beginning of a video, thinned evenly to a few dozen images."""
        samples: list[Image] = []
        step = 1
        for number, image in enumerate(images):
            if number % step:
                continue
            samples.append(image)
            if len(samples) == 2 * _SAMPLES:
                samples, step = samples[::2], step * 2
        if not samples:
            return
        # In the middle of the recording's sway, so that all others have the shortest way.
        self._begin(samples[len(samples) // 2])
        stack = np.stack([self.align(image)[0] for image in samples])
        background, noise = np.empty(stack.shape[1:], np.float32), np.empty(stack.shape[1:3], np.float32)
        for row in range(0, stack.shape[1], _BAND):
            mode, spread = _mode(stack[:, row : row + _BAND])
            background[row : row + _BAND], noise[row : row + _BAND] = mode, spread
        self.background = background
        self._noise = np.asarray(cv2.blur(np.clip(noise, *_NOISE_RANGE), (5, 5)), dtype=np.float32)
        self._edges = _edges(background)
        self._reference = None
        self.shadow = self._shadow_level(stack[:: max(1, len(stack) // 24)])

    def observe(self, image: Image) -> None:
        """Follow the scene by one image."""
        if self.background is None or self.background.shape != image.shape:
            self._begin(image)
        assert self.background is not None
        assert self._noise is not None
        image, _ = self.align(image)
        smooth = np.asarray(cv2.blur(image, (3, 3)), dtype=np.uint8)
        if self._previous is None or self._still is None:
            self._previous, self._still = smooth, np.zeros(image.shape[:2], dtype=np.uint8)
        changed = self.changed(image)
        near = cv2.dilate(changed.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        difference = image - self.background
        flicker = strongest(np.abs(difference))
        np.clip(difference, -1, 1, out=difference)
        difference[near] = 0
        self.background += difference
        self._noise += np.where(near, 0, np.clip(flicker * 1.5 - self._noise, -0.05, 0.05)).astype(np.float32)
        np.clip(self._noise, *_NOISE_RANGE, out=self._noise)

        moved = strongest(cv2.absdiff(smooth, self._previous)) > _STILL_LEVELS
        self._still = np.where(moved | ~changed, 0, np.minimum(self._still, 254) + 1).astype(np.uint8)
        self._previous = smooth
        self._observed += 1
        if self._observed % _STILL_GHOST == 0:
            self._absorb(image)
            self._edges = _edges(self.background)
        self._reference = None

    def align(self, image: Image) -> tuple[Image, tuple[int, int]]:
        """The image moved onto the model by whole pixels, and by how many (x, y) it was moved."""
        assert self._edges is not None
        assert self.background is not None
        here = _edges(image.astype(np.float32))
        window = _hanning_window(here.shape[1], here.shape[0])
        # OpenCV multiplies what it is given by the window, in place, where the size suits its Fourier transform.
        (dx, dy), response = cv2.phaseCorrelate(here, self._edges.copy(), window)
        low, high = _SHIFT_RANGE
        distance = float(np.hypot(dx, dy)) * 2
        if response < _SHIFT_RESPONSE or not low <= distance <= high:
            return image, (0, 0)
        self._sways = True
        shift = round(dx * 2), round(dy * 2)
        h, w = image.shape[:2]
        # What the image does not show is taken to be empty.
        moved = np.rint(self.background).astype(np.uint8)
        to_x, to_y = (np.s_[max(0, d) : n + min(0, d)] for d, n in zip(shift, (w, h), strict=True))
        from_x, from_y = (np.s_[max(0, -d) : n + min(0, -d)] for d, n in zip(shift, (w, h), strict=True))
        moved[to_y, to_x] = image[from_y, from_x]
        return moved, shift

    def differences(self, image: Image) -> list[Difference]:
        """Where an aligned image may differ from the empty scene, and how it does."""
        reference = self._compared_with()
        gains = self._gains(image, reference)
        smooth = np.asarray(cv2.blur(image, (3, 3)), dtype=np.uint8)
        levels = np.clip(np.rint(np.arange(256, dtype=np.float32)[:, None] * gains), 0, 255).astype(np.uint8)
        away = cv2.absdiff(smooth, cv2.LUT(reference.levels, levels[None]))
        boxes = boxes_around(np.asarray(cv2.subtract(away, reference.quiet), dtype=np.uint8))
        return [self._difference(box, smooth, reference, gains) for box in boxes]

    def changed(self, image: Image) -> BoolMask:
        """(H, W) which pixels of an aligned image differ from the background."""
        changed = np.zeros(image.shape[:2], dtype=np.bool_)
        for part in self.differences(image):
            changed[part.box] = part.amount > part.threshold
        return changed

    def _compared_with(self) -> _Reference:
        if self._reference is None:
            assert self.background is not None
            assert self._noise is not None
            smooth = np.asarray(cv2.blur(self.background, (3, 3)), dtype=np.float32)
            quiet = (self._limit(np.s_[:, :]) - _ROUNDING_LEVELS).astype(np.uint8)
            sample = np.ascontiguousarray(self.background[::4, ::4].reshape(-1, 3).T)
            quiet = np.repeat(quiet[..., None], 3, axis=2)
            self._reference = _Reference(smooth, np.rint(smooth).astype(np.uint8), quiet, sample)
        return self._reference

    def _gains(self, image: Image, reference: _Reference) -> Plane:
        """(3,) exposure of an image, which cameras keep changing, relative to the background's."""
        now = np.ascontiguousarray(image[::4, ::4].reshape(-1, 3).T).astype(np.float32)
        gains: Plane = np.clip(np.median((now + 8) / (reference.sample + 8), axis=1), *_GAINS).astype(np.float32)
        return gains

    def _difference(self, box: Box, smooth: Image, reference: _Reference, gains: Plane) -> Difference:
        seen, expected = smooth[box].astype(np.float32), _times(reference.smooth[box], gains)
        amount = strongest(cv2.absdiff(seen, expected))
        steep = cv2.dilate(slope(lightness(expected)) / 8, np.ones((3, 3), np.uint8))
        threshold = np.asarray(self._limit(box) + _SWAY_PX[self._sways] * steep, dtype=np.float32)
        rows, columns = box
        height, width = smooth.shape[:2]
        sides = (rows.start > 0, rows.stop < height, columns.start > 0, columns.stop < width)
        return Difference(box, sides, seen, expected, amount, threshold)

    def _limit(self, box: Box) -> Plane:
        """(h, w) difference, in grey levels, that flicker does not explain."""
        assert self._noise is not None
        return np.asarray(np.maximum(np.float32(_CHANGE_LEVELS), np.float32(_CHANGE_SIGMAS) * self._noise[box]))

    def _begin(self, image: Image) -> None:
        self.background = image.astype(np.float32)
        self._noise = np.full(image.shape[:2], 3.0, dtype=np.float32)
        self._edges = _edges(self.background)
        self._previous = self._reference = None

    def _absorb(self, image: Image) -> None:
        assert self._still is not None
        assert self.background is not None
        longer = (self._still >= _STILL_GHOST).view(np.uint8)
        still = cv2.morphologyEx(longer, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(still)
        for i in range(1, count):
            x, y, w, h, _ = stats[i].tolist()
            here = np.s_[max(0, y - 3) : y + h + 3, max(0, x - 3) : x + w + 3]
            part = labels[here] == i
            old = self._still[here][part].mean() >= _STILL_FOREVER
            if old or is_ghost(part, image[here], self.background[here]):
                grown = cv2.dilate(part.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
                self.background[here][grown] = image[here][grown]
                self._still[here][grown] = 0

    def _shadow_level(self, images: Image) -> float:
        """Most frequent brightness, relative to the scene, of what is flat, dark and of the scene's colour."""
        counts = np.zeros(20, dtype=np.int64)
        for image in images:
            for part in self.differences(image):
                light = lightness(part.smooth)
                ratio = (light + 4) / (lightness(part.expected) + 4)
                changed = (part.amount > part.threshold).view(np.uint8)
                inside = cv2.erode(changed, np.ones((5, 5), np.uint8)) > 0
                colour = stain(part, ratio)
                flat = inside & (slope(light) < 22) & (colour < 10)
                counts += np.histogram(ratio[flat], counts.size, (0, 1))[0]
        if counts.sum() < 200:
            return _TYPICAL_SHADOW
        smoothed = np.convolve(counts, [1, 2, 1], mode="same")
        return float((smoothed.argmax() + 0.5) / counts.size)


def _times(picture: Plane, factors: Plane) -> Plane:
    """A picture (H, W, 3) times a factor (3,) per channel: along whole rows, which NumPy is several times faster at."""
    height, width, _ = picture.shape
    rows = np.ascontiguousarray(picture).reshape(height, -1) * np.tile(factors, width)
    return np.asarray(rows.reshape(picture.shape), dtype=np.float32)


def lightness(picture: Plane) -> Plane:
    """(H, W) mean of the channels of (H, W, 3)."""
    return np.asarray(cv2.transform(picture, np.full((1, 3), 1 / 3)))


def strongest(picture: NDArray[Any]) -> NDArray[Any]:
    """(H, W) greatest of the channels of (H, W, 3)."""
    return np.asarray(np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2]))


def stain(part: Difference, ratio: Plane) -> Plane:
    """(h, w) by how much a part differs from the empty scene made brighter or darker by a ratio (h, w)."""
    return strongest(cv2.absdiff(part.smooth, part.expected * cv2.merge((ratio, ratio, ratio))))


def is_ghost(mask: BoolMask, image: Image, background: Plane) -> bool:
    """Whether a changed region's outline is an edge of the background rather than of the image.

    Args:
        mask: (h, w) the region, with a margin of some pixels around it.
        image, background: (h, w, 3) the same part of both.
    """
    kernel = np.ones((3, 3), np.uint8)
    rim = (cv2.dilate(mask.view(np.uint8), kernel) > 0) & ~(cv2.erode(mask.view(np.uint8), kernel) > 0)
    if not rim.any():
        return False
    strengths = []
    for picture in (image, background):
        strengths.append(slope(lightness(np.asarray(picture, dtype=np.float32)))[rim].mean())
    return bool(strengths[1] > 1.5 * strengths[0])


@lru_cache(maxsize=4)
def _hanning_window(width: int, height: int) -> Plane:
    return np.asarray(cv2.createHanningWindow((width, height), cv2.CV_32F), dtype=np.float32)


def _edges(picture: Plane) -> Plane:
    """Edge strength at half size, strong edges cut off so that vehicles do not lead the alignment."""
    half = np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.float32)
    return np.minimum(slope(lightness(half)), 80)


def slope(grey: Plane) -> Plane:
    """Length of the gradient, 8 times grey levels per px."""
    return np.asarray(cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)))


def _mode(stack: Image) -> tuple[Plane, Plane]:
    """Mode and spread of samples (n, h, w, 3): the middle of the shortest interval that holds a share of them."""
    ordered = in_order(stack)
    n = len(ordered)
    held = max(1, round(n * _MODE_SHARE))
    widths = ordered[held - 1 :] - ordered[: n - held + 1]
    start = widths.argmin(axis=0)[None]
    low, middle, high = (
        np.take_along_axis(ordered, start + k, axis=0)[0].astype(np.float32) for k in (0, held // 2, held - 1)
    )
    return middle, (high - low).max(axis=2)
