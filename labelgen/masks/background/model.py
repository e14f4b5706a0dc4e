"""Background model of a fixed camera: the empty scene per pixel, its flicker, and how dark its shadows are.

The model starts as the mode of each pixel's colours over the beginning of a video, which dense traffic disturbs less
than the median. Then it follows the light by one grey level per frame, away from vehicles: the sigma-delta filter,
which tracks the median. What stands still for long becomes background. A ghost, an object that the model shows and
that has left the scene, is replaced at once. Images are aligned with the model first, because masts and bridges sway.

Source: Manzanera & Richefeu, "A new motion detection algorithm based on sigma-delta background estimation", Pattern
Recognition Letters 2007 (sigma-delta filter).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.channels import channel_max, channel_mean, gradient_magnitude, scale_channels
from labelgen.masks.background.morphology import Box, disjoint_boxes
from labelgen.masks.background.sorting_network import sort_samples

__all__ = ["MODEL", "BackgroundModel", "Difference", "ModelThresholds", "colour_residual", "is_ghost"]

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]
BoolMask = NDArray[np.bool_]

# Rows of all samples that are sorted at once; so many fit into the processor's cache.
_BAND_ROWS = 16
# Rounding two pictures to whole grey levels changes their difference by at most this.
_ROUNDING_LEVELS = 2
# Gradients, 8 times grey levels per px, are clipped here so that vehicles do not dominate the alignment.
_EDGE_CLIP = 80


@dataclass(frozen=True)
class ModelThresholds:
    """Thresholds of the background model. Grey levels are 0 to 255; observations are calls of `observe`.

    Args:
        samples: the mode is computed from this many images of a long video, to twice as many. More of them resist
            denser traffic, and cost memory and time.
        mode_share: share of a pixel's samples in the shortest interval that gives the mode. Vehicles may cover a pixel
            in the rest of the samples; a smaller share is noisier.
        noise_range: least and greatest flicker of a pixel that is believed, grey levels.
        initial_noise: flicker of a pixel before it is measured, grey levels.
        noise_factor: a pixel's flicker follows the difference from the background times this factor.
        noise_step: greatest change of a pixel's flicker in one observation, grey levels.
        change_levels: least difference of a changed pixel, grey levels. A smaller one finds paint like the road's, and
            more noise.
        change_sigmas: the same in multiples of the pixel's flicker; the larger limit holds.
        sway_fixed_px: movement left after alignment where the camera never moved, px; times the gradient it is added
            to the limit above. Larger values lose vehicles beside strong edges.
        sway_moving_px: the same where the camera has moved.
        min_shift_response: least peak of the phase correlation for which a shift is believed.
        shift_range_px: least and greatest shift that is corrected, px.
        ghost_observations: observations without movement after which a changed region is tested for being a ghost.
        absorb_observations: observations without movement after which any region becomes background. A smaller number
            absorbs vehicles in a queue.
        static_levels: greatest change between two observations of a pixel without movement, grey levels.
        typical_shadow: brightness of a cast shadow relative to the ground, where too few are seen to measure it.
        shadow_pixels: pixels of cast shadows from which on their brightness is measured.
        shadow_gradient: greatest gradient inside a cast shadow, 8 times grey levels per px.
        shadow_residual: greatest colour residual inside a cast shadow, grey levels.
        gain_range: least and greatest exposure of an image, relative to the background's, that is corrected.
    """

    samples: int = 64
    mode_share: float = 0.4
    noise_range: tuple[float, float] = (1.5, 12.0)
    initial_noise: float = 3.0
    noise_factor: float = 1.5
    noise_step: float = 0.05
    change_levels: float = 12.0
    change_sigmas: float = 4.0
    sway_fixed_px: float = 0.05
    sway_moving_px: float = 0.3
    min_shift_response: float = 0.4
    shift_range_px: tuple[float, float] = (0.7, 24.0)
    ghost_observations: int = 8
    absorb_observations: int = 120
    static_levels: int = 8
    typical_shadow: float = 0.55
    shadow_pixels: int = 200
    shadow_gradient: float = 22
    shadow_residual: float = 10
    gain_range: tuple[float, float] = (0.7, 1.4)


MODEL = ModelThresholds()


@dataclass(frozen=True, eq=False)
class Difference:
    """Part of an image that may differ from the empty scene. Outside of all parts the image does not differ.

    Args:
        box: rows and columns of the part in the image.
        open_sides: whether the frame goes on above, below, to the left and to the right of the part. Along such a side
            nothing differs within `labelgen.masks.background.morphology.MARGIN_PX`.
        smooth: (h, w, 3) float32, the image, slightly smoothed.
        expected: (h, w, 3) float32, the empty scene, equally smoothed, at the exposure of the image.
        amount: (h, w) float32, the difference of both, grey levels.
        threshold: (h, w) float32, greatest difference that flicker or sway explains, grey levels.
    """

    box: Box
    open_sides: tuple[bool, bool, bool, bool]
    smooth: Plane
    expected: Plane
    amount: Plane
    threshold: Plane


@dataclass(frozen=True, eq=False)
class _Reference:
    """The empty scene in the form that images are compared with.

    Args:
        smooth: (H, W, 3) float32, slightly smoothed.
        levels: the same, rounded to whole grey levels.
        quiet: (H, W, 3) uint8, differences in whole grey levels up to which a pixel has certainly not changed.
        sample: (3, N) float32, a sample of the background's pixels, from which the exposure is estimated.
    """

    smooth: Plane
    levels: Image
    quiet: Image
    sample: Plane


class BackgroundModel:
    """The empty scene of a fixed camera. Images are (H, W, 3) uint8 BGR, all of one size.

    Args:
        thresholds: of this stage.

    Attributes:
        background: (H, W, 3) float32 BGR; None before the first image.
        shadow: typical brightness of a flat cast shadow, relative to the ground without it.
    """

    def __init__(self, thresholds: ModelThresholds = MODEL) -> None:
        self._thresholds = thresholds
        self.background: Plane | None = None
        self.shadow = thresholds.typical_shadow
        self._noise: Plane | None = None
        self._edges: Plane | None = None
        self._previous: Image | None = None
        self._static: NDArray[np.uint8] | None = None
        self._observation_count = 0
        self._sways = False
        self._reference: _Reference | None = None

    def prime(self, images: Iterable[Image]) -> None:
        """Learn the empty scene from the beginning of a video; a few dozen of the images are used, evenly spaced."""
        samples: list[Image] = []
        step = 1
        for number, image in enumerate(images):
            if number % step:
                continue
            samples.append(image)
            if len(samples) == 2 * self._thresholds.samples:
                samples, step = samples[::2], step * 2
        if not samples:
            return
        # An image from the middle, so that the others need the shortest shifts.
        self._reset(samples[len(samples) // 2])
        stack = np.stack([self.align(image)[0] for image in samples])
        background, noise = np.empty(stack.shape[1:], np.float32), np.empty(stack.shape[1:3], np.float32)
        for row in range(0, stack.shape[1], _BAND_ROWS):
            band = np.s_[row : row + _BAND_ROWS]
            background[band], noise[band] = _mode(stack[:, band], self._thresholds.mode_share)
        self.background = background
        self._noise = np.asarray(cv2.blur(np.clip(noise, *self._thresholds.noise_range), (5, 5)), dtype=np.float32)
        self._edges = _edges(background)
        self._reference = None
        self.shadow = self._shadow_level(stack[:: max(1, len(stack) // 24)])

    def observe(self, image: Image) -> None:
        """Update the model with one image (H, W, 3) uint8 BGR."""
        if self.background is None or self.background.shape != image.shape:
            self._reset(image)
        assert self.background is not None
        assert self._noise is not None
        image, _ = self.align(image)
        smooth = np.asarray(cv2.blur(image, (3, 3)), dtype=np.uint8)
        if self._previous is None or self._static is None:
            self._previous, self._static = smooth, np.zeros(image.shape[:2], dtype=np.uint8)
        changed = self.changed(image)
        near = cv2.dilate(changed.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        difference = image - self.background
        flicker = channel_max(np.abs(difference))
        np.clip(difference, -1, 1, out=difference)
        difference[near] = 0
        self.background += difference
        step = self._thresholds.noise_step
        growth = np.clip(flicker * self._thresholds.noise_factor - self._noise, -step, step)
        self._noise += np.where(near, 0, growth).astype(np.float32)
        np.clip(self._noise, *self._thresholds.noise_range, out=self._noise)

        moved = channel_max(cv2.absdiff(smooth, self._previous)) > self._thresholds.static_levels
        self._static = np.where(moved | ~changed, 0, np.minimum(self._static, 254) + 1).astype(np.uint8)
        self._previous = smooth
        self._observation_count += 1
        if self._observation_count % self._thresholds.ghost_observations == 0:
            self._absorb_static(image)
            self._edges = _edges(self.background)
        self._reference = None

    def align(self, image: Image) -> tuple[Image, tuple[int, int]]:
        """Return the image shifted onto the model by whole pixels, and the shift (x, y), px."""
        assert self._edges is not None
        assert self.background is not None
        edges = _edges(image.astype(np.float32))
        window = _hanning_window(edges.shape[1], edges.shape[0])
        # OpenCV multiplies its arguments by the window in place where the size suits its Fourier transform.
        (dx, dy), response = cv2.phaseCorrelate(edges, self._edges.copy(), window)
        low, high = self._thresholds.shift_range_px
        distance = float(np.hypot(dx, dy)) * 2
        if response < self._thresholds.min_shift_response or not low <= distance <= high:
            return image, (0, 0)
        self._sways = True
        shift = round(dx * 2), round(dy * 2)
        h, w = image.shape[:2]
        # Pixels that the image does not show are taken from the background.
        moved = np.rint(self.background).astype(np.uint8)
        to_x, to_y = (np.s_[max(0, d) : n + min(0, d)] for d, n in zip(shift, (w, h), strict=True))
        from_x, from_y = (np.s_[max(0, -d) : n + min(0, -d)] for d, n in zip(shift, (w, h), strict=True))
        moved[to_y, to_x] = image[from_y, from_x]
        return moved, shift

    def differences(self, image: Image) -> list[Difference]:
        """Compare an aligned image with the empty scene: the parts in which it may differ."""
        reference = self._current_reference()
        gains = self._gains(image, reference)
        smooth = np.asarray(cv2.blur(image, (3, 3)), dtype=np.uint8)
        levels = np.clip(np.rint(np.arange(256, dtype=np.float32)[:, None] * gains), 0, 255).astype(np.uint8)
        rough = cv2.absdiff(smooth, cv2.LUT(reference.levels, levels[None]))
        boxes = disjoint_boxes(np.asarray(cv2.subtract(rough, reference.quiet), dtype=np.uint8))
        return [self._difference(box, smooth, reference, gains) for box in boxes]

    def changed(self, image: Image) -> BoolMask:
        """Return (H, W) bool: which pixels of an aligned image differ from the empty scene."""
        changed = np.zeros(image.shape[:2], dtype=np.bool_)
        for part in self.differences(image):
            changed[part.box] = part.amount > part.threshold
        return changed

    def _current_reference(self) -> _Reference:
        if self._reference is None:
            assert self.background is not None
            assert self._noise is not None
            smooth = np.asarray(cv2.blur(self.background, (3, 3)), dtype=np.float32)
            quiet = (self._flicker_threshold(np.s_[:, :]) - _ROUNDING_LEVELS).astype(np.uint8)
            sample = np.ascontiguousarray(self.background[::4, ::4].reshape(-1, 3).T)
            quiet = np.repeat(quiet[..., None], 3, axis=2)
            self._reference = _Reference(smooth, np.rint(smooth).astype(np.uint8), quiet, sample)
        return self._reference

    def _gains(self, image: Image, reference: _Reference) -> Plane:
        """Return the exposure (3,) of an image relative to the background's; cameras keep changing it."""
        sample = np.ascontiguousarray(image[::4, ::4].reshape(-1, 3).T).astype(np.float32)
        ratios = np.median((sample + 8) / (reference.sample + 8), axis=1)
        gains: Plane = np.clip(ratios, *self._thresholds.gain_range).astype(np.float32)
        return gains

    def _difference(self, box: Box, smooth: Image, reference: _Reference, gains: Plane) -> Difference:
        observed, expected = smooth[box].astype(np.float32), scale_channels(reference.smooth[box], gains)
        amount = channel_max(cv2.absdiff(observed, expected))
        gradient = cv2.dilate(gradient_magnitude(channel_mean(expected)) / 8, np.ones((3, 3), np.uint8))
        sway_px = self._thresholds.sway_moving_px if self._sways else self._thresholds.sway_fixed_px
        threshold = np.asarray(self._flicker_threshold(box) + sway_px * gradient, dtype=np.float32)
        rows, columns = box
        height, width = smooth.shape[:2]
        sides = (rows.start > 0, rows.stop < height, columns.start > 0, columns.stop < width)
        return Difference(box, sides, observed, expected, amount, threshold)

    def _flicker_threshold(self, box: Box) -> Plane:
        """Return (h, w) the greatest difference that flicker explains, grey levels."""
        assert self._noise is not None
        levels, sigmas = np.float32(self._thresholds.change_levels), np.float32(self._thresholds.change_sigmas)
        return np.asarray(np.maximum(levels, sigmas * self._noise[box]))

    def _reset(self, image: Image) -> None:
        """Take one image for the empty scene."""
        self.background = image.astype(np.float32)
        self._noise = np.full(image.shape[:2], self._thresholds.initial_noise, dtype=np.float32)
        self._edges = _edges(self.background)
        self._previous = self._reference = None

    def _absorb_static(self, image: Image) -> None:
        """Make ghosts, and regions without movement for long, part of the background."""
        assert self._static is not None
        assert self.background is not None
        is_static = (self._static >= self._thresholds.ghost_observations).view(np.uint8)
        candidates = cv2.morphologyEx(is_static, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(candidates)
        for i in range(1, count):
            x, y, w, h, _ = stats[i].tolist()
            window = np.s_[max(0, y - 3) : y + h + 3, max(0, x - 3) : x + w + 3]
            region = labels[window] == i
            is_old = self._static[window][region].mean() >= self._thresholds.absorb_observations
            if is_old or is_ghost(region, image[window], self.background[window]):
                grown = cv2.dilate(region.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
                self.background[window][grown] = image[window][grown]
                self._static[window][grown] = 0

    def _shadow_level(self, images: Image) -> float:
        """Return the most frequent brightness, relative to the scene, of flat dark pixels of the scene's colour."""
        limits, counts = self._thresholds, np.zeros(20, dtype=np.int64)
        for image in images:
            for part in self.differences(image):
                light = channel_mean(part.smooth)
                ratio = (light + 4) / (channel_mean(part.expected) + 4)
                changed = (part.amount > part.threshold).view(np.uint8)
                inside = cv2.erode(changed, np.ones((5, 5), np.uint8)) > 0
                flat = gradient_magnitude(light) < limits.shadow_gradient
                shadow = inside & flat & (colour_residual(part, ratio) < limits.shadow_residual)
                counts += np.histogram(ratio[shadow], counts.size, (0, 1))[0]
        if counts.sum() < limits.shadow_pixels:
            return limits.typical_shadow
        smoothed = np.convolve(counts, [1, 2, 1], mode="same")
        return float((smoothed.argmax() + 0.5) / counts.size)


def colour_residual(part: Difference, ratio: Plane) -> Plane:
    """Return (h, w) the difference that a change of brightness leaves unexplained, grey levels.

    Args:
        part: an image and the empty scene.
        ratio: (h, w) brightness of the image relative to the empty scene.
    """
    return channel_max(cv2.absdiff(part.smooth, part.expected * cv2.merge((ratio, ratio, ratio))))


def is_ghost(mask: BoolMask, image: Image, background: Plane, *, edge_ratio: float = 1.5) -> bool:
    """Return whether a changed region's outline is an edge of the background rather than of the image.

    Args:
        mask: (h, w) bool, the region, with a margin of some pixels around it.
        image, background: (h, w, 3) the same part of both, uint8 or float32.
        edge_ratio: least gradient along the outline in the background, relative to that in the image. A smaller ratio
            drops vehicles on strong edges.
    """
    kernel = np.ones((3, 3), np.uint8)
    rim = (cv2.dilate(mask.view(np.uint8), kernel) > 0) & ~(cv2.erode(mask.view(np.uint8), kernel) > 0)
    if not rim.any():
        return False
    strengths = []
    for picture in (image, background):
        strengths.append(gradient_magnitude(channel_mean(np.asarray(picture, dtype=np.float32)))[rim].mean())
    return bool(strengths[1] > edge_ratio * strengths[0])


@lru_cache(maxsize=4)
def _hanning_window(width: int, height: int) -> Plane:
    return np.asarray(cv2.createHanningWindow((width, height), cv2.CV_32F), dtype=np.float32)


def _edges(picture: Plane) -> Plane:
    """Return the gradient magnitude at half size, clipped."""
    half = np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.float32)
    return np.minimum(gradient_magnitude(channel_mean(half)), _EDGE_CLIP)


def _mode(samples: Image, share: float) -> tuple[Plane, Plane]:
    """Return mode (h, w, 3) and spread (h, w) of samples (n, h, w, 3).

    The mode is the middle of the shortest interval that holds the share of the samples; the spread is the interval's
    length.
    """
    ordered = sort_samples(samples)
    n = len(ordered)
    held = max(1, round(n * share))
    widths = ordered[held - 1 :] - ordered[: n - held + 1]
    start = widths.argmin(axis=0)[None]
    low, middle, high = (
        np.take_along_axis(ordered, start + k, axis=0)[0].astype(np.float32) for k in (0, held // 2, held - 1)
    )
    return middle, (high - low).max(axis=2)
