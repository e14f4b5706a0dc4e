"""Augmentation: one axis-aligned map for image, boxes, c_c and VPU, and changes of light.

A map scales x and y, shifts, and may flip x. Such a map leaves c_c as it is, and takes VPU with it, so the 3D box that
a label decodes to is mapped like everything else. Where the picture's border cuts a box, its c_c is that of the line at
the same height in the part that is left, and not known where that line is cut away.

Source: Kocur & Ftacnik 2020, section 3.4 (ranges).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.geometry.homography import Array
from labelgen.labels import Flag, Labels

__all__ = ["AugmentationRanges", "AxisAlignedAffine", "Target", "clip_to_image", "jitter_color", "sample_affine"]


@dataclass(frozen=True)
class AxisAlignedAffine:
    """x' = scale_x * x + shift_x, likewise y; scale_x is negative for a flip.

    Args:
        scale_xy, shift_xy: (2,) px of the new image per px of the old one, and px.
    """

    scale_xy: tuple[float, float]
    shift_xy: tuple[float, float]

    def points(self, points: ArrayLike) -> Array:
        """Points (..., 2) in the new image."""
        out: Array = np.asarray(points, dtype=np.float64) * self.scale_xy + self.shift_xy
        return out

    def boxes(self, boxes_xyxy: ArrayLike) -> Array:
        """Boxes (N, 4) in the new image."""
        corners = self.points(np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 2, 2))
        return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)

    def image(self, image: NDArray[np.uint8], size_wh: tuple[int, int]) -> NDArray[np.uint8]:
        """The new image (H, W, 3), black where the old one does not reach."""
        (sx, sy), (tx, ty) = self.scale_xy, self.shift_xy
        # OpenCV puts pixel centres on whole numbers; pixels here are areas.
        matrix = np.array([[sx, 0, tx + 0.5 * sx - 0.5], [0, sy, ty + 0.5 * sy - 0.5]])
        if min(abs(sx), abs(sy)) < 0.5:
            # Linear interpolation alone would skip pixels.
            shrink = max(1, round(1 / max(abs(sx), abs(sy))))
            small = (max(1, image.shape[1] // shrink), max(1, image.shape[0] // shrink))
            fx, fy = small[0] / image.shape[1], small[1] / image.shape[0]
            return AxisAlignedAffine((sx / fx, sy / fy), (tx, ty)).image(
                np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA), dtype=np.uint8), size_wh
            )
        return np.asarray(cv2.warpAffine(image, matrix, size_wh, flags=cv2.INTER_LINEAR), dtype=np.uint8)


@dataclass(frozen=True)
class AugmentationRanges:
    """How far augmentation may go.

    Args:
        translation: greatest shift as a share of the picture's size, either way.
        scale: least and greatest scale; for crops relative to a crop that fills the picture.
        aspect: greatest factor by which x and y scales differ, at least 1.
        flip: probability of a horizontal flip.
        light: strength of changes of brightness, contrast and colour; 0 for none.
    """

    translation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    aspect: float = 1.0
    flip: float = 0.0
    light: float = 0.0


@dataclass(frozen=True, eq=False)
class Target:
    """Labels of an augmented image.

    Args:
        boxes_xyxy: (N, 4) px, inside the image.
        cc: (N,); 0 where not known.
        cc_known: (N,) bool.
    """

    boxes_xyxy: Array
    cc: Array
    cc_known: NDArray[np.bool_]

    @classmethod
    def of(cls, labels: Labels) -> Target:
        """Labels as they are; c_c is not known where there is none, nor of truncated ones, whose box is only a part."""
        known = ~labels.has(Flag.TRUNCATED) & ~labels.has(Flag.FLAT)
        return cls(labels.boxes_xyxy, np.where(known, labels.cc, 0.0), known)


def sample_affine(
    rng: np.random.Generator,
    ranges: AugmentationRanges,
    from_wh: tuple[int, int],
    to_wh: tuple[int, int],
    *,
    fill: bool = False,
) -> AxisAlignedAffine:
    """A random map from one image to another.

    Args:
        rng: decides.
        ranges: how far it may go.
        from_wh, to_wh: sizes of the two images.
        fill: whether scale 1 fills the new image with the old one, whatever its size, as for crops.
    """
    base = np.divide(to_wh, from_wh) if fill else np.ones(2)
    low, high = ranges.scale
    scale = rng.uniform(low, high)
    skew = np.sqrt(ranges.aspect) ** rng.uniform(-1, 1)
    both = base * scale * np.array([skew, 1 / skew])
    shift = rng.uniform(-ranges.translation, ranges.translation, 2) * to_wh
    flipped = rng.random() < ranges.flip
    size = np.asarray(from_wh) * both
    left, top = (np.asarray(to_wh) - size) / 2 + shift
    if flipped:
        return AxisAlignedAffine((-float(both[0]), float(both[1])), (float(left + size[0]), float(top)))
    return AxisAlignedAffine((float(both[0]), float(both[1])), (float(left), float(top)))


def clip_to_image(
    target: Target, size_wh: tuple[int, int], *, min_share: float = 0.25, min_side: float = 4.0
) -> Target:
    """Cut boxes at the image's border.

    Args:
        target: labels, anywhere.
        size_wh: of the image.
        min_share: labels of which a smaller share of the area is left go.
        min_side: labels with a shorter side, px, go.
    """
    boxes = target.boxes_xyxy
    size = np.array([*size_wh, *size_wh], dtype=np.float64)
    cut = np.clip(boxes, 0, size)
    sides, whole = cut[:, 2:] - cut[:, :2], boxes[:, 2:] - boxes[:, :2]
    keep = (sides >= min_side).all(axis=1) & (sides.prod(axis=1) >= min_share * whole.prod(axis=1))
    line = boxes[:, 1] + target.cc * whole[:, 1]
    known = target.cc_known & (line >= cut[:, 1]) & (line <= cut[:, 3])
    with np.errstate(divide="ignore", invalid="ignore"):
        cc = np.where(known, (line - cut[:, 1]) / sides[:, 1], 0.0)
    return Target(cut[keep], np.clip(cc[keep], 0, 1), known[keep])


def jitter_color(rng: np.random.Generator, image: NDArray[np.uint8], strength: float) -> NDArray[np.uint8]:
    """Random brightness, contrast, gamma and tint; strength about 0.3 is plenty.

    Args:
        rng: decides.
        image: (H, W, 3) uint8.
        strength: 0 for none.
    """
    gamma = np.exp(rng.uniform(-strength, strength))
    gain = np.exp(rng.uniform(-strength, strength)) * np.exp(rng.uniform(-strength, strength, 3) / 4)
    lift = rng.uniform(-strength, strength) * 64
    levels = (np.arange(256) / 255) ** gamma
    table = np.clip(np.round(255 * levels[:, None] * gain + lift), 0, 255).astype(np.uint8)
    # What lies outside the old image stays black, as it is in use.
    table[0] = 0
    return np.asarray(cv2.LUT(image, table[:, None, :]), dtype=np.uint8)
