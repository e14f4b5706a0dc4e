"""Augmentation: one axis-aligned affine map for image, boxes, c_c and VPU, and changes of color.

The map scales x and y, shifts, and may flip x. It leaves c_c unchanged and moves VPU, so that the 3D box a label
decodes to is mapped like the image. Where the picture's border cuts a box, c_c is computed anew so that its line stays
at the same height; where that line is cut off, c_c is not known.

Source: Kocur & Ftacnik 2020, section 3.4 (ranges).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.geometry.homography import Array
from labelgen.labels import Flag, IgnoredBoxes, Labels

__all__ = [
    "AugmentationRanges",
    "AxisAlignedAffine",
    "TrainingTarget",
    "clip_to_image",
    "jitter_color",
    "sample_affine",
]


@dataclass(frozen=True)
class AxisAlignedAffine:
    """The map x' = scale_x * x + shift_x, likewise y.

    Args:
        scale_xy: px of the new image per px of the old one; scale_x is negative for a flip.
        shift_xy: px of the new image.
    """

    scale_xy: tuple[float, float]
    shift_xy: tuple[float, float]

    def points(self, points: ArrayLike) -> Array:
        """Map points (..., 2) px to the new image."""
        out: Array = np.asarray(points, dtype=np.float64) * self.scale_xy + self.shift_xy
        return out

    def boxes(self, boxes_xyxy: ArrayLike) -> Array:
        """Map boxes (N, 4) px to the new image."""
        corners = self.points(np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 2, 2))
        return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)

    def warp_image(self, image: NDArray[np.uint8], size_wh: tuple[int, int]) -> NDArray[np.uint8]:
        """Resample an image (H, W, 3) uint8 to a new one of size_wh px, black outside the old one."""
        (sx, sy), (tx, ty) = self.scale_xy, self.shift_xy
        # OpenCV has pixel centres at whole numbers; here pixels are areas, with centres at halves.
        matrix = np.array([[sx, 0, tx + 0.5 * sx - 0.5], [0, sy, ty + 0.5 * sy - 0.5]])
        if min(abs(sx), abs(sy)) < 0.5:
            # Linear interpolation alone would skip pixels: shrink by averaging first.
            shrink = max(1, round(1 / max(abs(sx), abs(sy))))
            small = (max(1, image.shape[1] // shrink), max(1, image.shape[0] // shrink))
            fx, fy = small[0] / image.shape[1], small[1] / image.shape[0]
            return AxisAlignedAffine((sx / fx, sy / fy), (tx, ty)).warp_image(
                np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA), dtype=np.uint8), size_wh
            )
        return np.asarray(cv2.warpAffine(image, matrix, size_wh, flags=cv2.INTER_LINEAR), dtype=np.uint8)


@dataclass(frozen=True)
class AugmentationRanges:
    """Ranges from which augmentation is drawn. Field names are part of the checkpoint format.

    Args:
        translation: largest shift, as a share of the picture's width and height, in either direction.
        scale: smallest and largest scale; for crops, 1 is a crop that fills the picture.
        aspect: largest ratio of the scales of x and y, at least 1.
        flip: probability of a horizontal flip, in [0, 1].
        light: strength of changes of brightness, contrast and color, see `jitter_color`; 0 for none.
    """

    translation: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    aspect: float = 1.0
    flip: float = 0.0
    light: float = 0.0


@dataclass(frozen=True, eq=False)
class TrainingTarget:
    """What is learnt from the labels of one image.

    Args:
        boxes_xyxy: (N, 4) px.
        cc: (N,) in [0, 1]; 0 where not known.
        cc_known: (N,) bool, whether c_c is learnt.
        ignored_xyxy: (K, 4) px, boxes that are learnt from neither as vehicles nor as background.
    """

    boxes_xyxy: Array
    cc: Array
    cc_known: NDArray[np.bool_]
    ignored_xyxy: Array = field(default_factory=lambda: np.empty((0, 4)))

    @classmethod
    def from_labels(
        cls, labels: Labels, ignored: IgnoredBoxes | None = None, max_sigma: float | None = None
    ) -> TrainingTarget:
        """Take over boxes and c_c; c_c is not known for flat labels, and for truncated ones, whose box is cut.

        Args:
            labels: of one image.
            ignored: boxes of its vehicles without a label.
            max_sigma: labels whose stated standard deviation of c_c is larger are ignored; None to keep all. Labels
                that state none are kept.
        """
        known = ~labels.has(Flag.TRUNCATED) & ~labels.has(Flag.FLAT)
        ignored_xyxy = IgnoredBoxes.empty().boxes_xyxy if ignored is None else ignored.boxes_xyxy
        unsure = np.zeros(len(labels), dtype=np.bool_) if max_sigma is None else labels.sigmas[:, 4] > max_sigma
        boxes, cc = labels.boxes_xyxy, np.where(known, labels.cc, 0.0)
        return cls(boxes[~unsure], cc[~unsure], known[~unsure], np.concatenate([ignored_xyxy, boxes[unsure]]))

    def moved(self, move: AxisAlignedAffine) -> TrainingTarget:
        """Map all boxes to the new image."""
        return replace(self, boxes_xyxy=move.boxes(self.boxes_xyxy), ignored_xyxy=move.boxes(self.ignored_xyxy))


def sample_affine(
    rng: np.random.Generator,
    ranges: AugmentationRanges,
    from_wh: tuple[int, int],
    to_wh: tuple[int, int],
    *,
    fill: bool = False,
) -> AxisAlignedAffine:
    """Draw a random map from one image to another, centred up to its shift.

    Args:
        rng: random numbers.
        ranges: of the map.
        from_wh: size px of the old image.
        to_wh: size px of the new image.
        fill: whether scale 1 fills the new image with the old one, as for crops; else scale 1 keeps the px.
    """
    base = np.divide(to_wh, from_wh) if fill else np.ones(2)
    low, high = ranges.scale
    scale = rng.uniform(low, high)
    skew = np.sqrt(ranges.aspect) ** rng.uniform(-1, 1)
    scale_xy = base * scale * np.array([skew, 1 / skew])
    shift = rng.uniform(-ranges.translation, ranges.translation, 2) * to_wh
    is_flipped = rng.random() < ranges.flip
    size = np.asarray(from_wh) * scale_xy
    left, top = (np.asarray(to_wh) - size) / 2 + shift
    scale_x, scale_y = scale_xy.tolist()
    if is_flipped:
        return AxisAlignedAffine((-scale_x, scale_y), (float(left + size[0]), float(top)))
    return AxisAlignedAffine((scale_x, scale_y), (float(left), float(top)))


def clip_to_image(
    target: TrainingTarget, size_wh: tuple[int, int], *, min_share: float = 0.25, min_side: float = 4.0
) -> TrainingTarget:
    """Clip boxes to the image; those of which too little remains are ignored.

    Args:
        target: boxes may lie outside the image.
        size_wh: of the image, px.
        min_share: smallest share of a label's area that must remain; less keeps vehicles nobody could recognise, more
            ignores visible ones.
        min_side: shortest side px that must remain.
    """
    boxes = target.boxes_xyxy
    size = np.array([*size_wh, *size_wh], dtype=np.float64)
    clipped, ignored = np.clip(boxes, 0, size), np.clip(target.ignored_xyxy, 0, size)
    sides, full_sides = clipped[:, 2:] - clipped[:, :2], boxes[:, 2:] - boxes[:, :2]
    keep = (sides >= min_side).all(axis=1) & (sides.prod(axis=1) >= min_share * full_sides.prod(axis=1))
    line = boxes[:, 1] + target.cc * full_sides[:, 1]
    known = target.cc_known & (line >= clipped[:, 1]) & (line <= clipped[:, 3])
    with np.errstate(divide="ignore", invalid="ignore"):
        cc = np.where(known, (line - clipped[:, 1]) / sides[:, 1], 0.0)
    ignored = np.concatenate([ignored, clipped[~keep]])
    ignored = ignored[(ignored[:, :2] < ignored[:, 2:]).all(axis=1)]
    return TrainingTarget(clipped[keep], np.clip(cc[keep], 0, 1), known[keep], ignored)


def jitter_color(rng: np.random.Generator, image: NDArray[np.uint8], strength: float) -> NDArray[np.uint8]:
    """Change brightness, contrast, gamma and tint at random.

    Args:
        rng: random numbers.
        image: (H, W, 3) uint8.
        strength: largest change: of the logarithms of gamma and contrast, and of brightness in 64 levels; 0.3 is a
            strong change.

    Returns:
        (H, W, 3) uint8; black pixels stay black.
    """
    gamma = np.exp(rng.uniform(-strength, strength))
    gain = np.exp(rng.uniform(-strength, strength)) * np.exp(rng.uniform(-strength, strength, 3) / 4)
    lift = rng.uniform(-strength, strength) * 64
    levels = (np.arange(256) / 255) ** gamma
    table = np.clip(np.round(255 * levels[:, None] * gain + lift), 0, 255).astype(np.uint8)
    # Black is what lies outside the old image; inference has the same.
    table[0] = 0
    return np.asarray(cv2.LUT(image, table[:, None, :]), dtype=np.uint8)
