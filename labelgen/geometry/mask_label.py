"""From a vehicle's mask in the rectified image to its 2D box and c_c.

Convention: a mask pixel covers [x, x + 1) x [y, y + 1). The box runs along pixel borders; the two tangents
from VPU touch the mask at pixel centres.

Source: Kocur & Ftacnik 2020, section 3.4 (tangents from VPU, the wider of the two candidates). The
"conditioned" rule weights the candidates by the inverse square of how far a shift of the tangent point by
0.7 px moves them: where a tangent runs almost along a side of the box, half a pixel moves its candidate far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.errors import LabelgenError
from labelgen.geometry.projective import Array, translation
from labelgen.geometry.rectification import Rectification

__all__ = ["MaskLabels", "Outline", "Rule", "label_outlines", "mask_outline", "rectified_outline"]

_TANGENT_SHIFT = 0.7
# A half-pixel error of a tangent is what most of the c_c error comes from, so masks are rectified onto a grid
# this many times finer than the image, or as much as keeps the mask's longer side under the given length.
_OVERSAMPLE = 4
_LONGEST_SIDE = 640


class Rule(StrEnum):
    """How the two candidates for c_c become one."""

    WIDER = "wider"
    CONDITIONED = "conditioned"

    @classmethod
    def parse(cls, text: str) -> Rule:
        """Rule from its name; LabelgenError names the known ones."""
        for rule in cls:
            if rule.value == text.strip().lower():
                return rule
        raise LabelgenError(f"--rule {text}: unknown rule; use one of {', '.join(r.value for r in cls)}")


@dataclass(frozen=True)
class Outline:
    """What of a rectified mask matters for its label: all its parts together.

    Args:
        box_xyxy: (4,) px, along pixel borders.
        hull: (K, 2) px, convex hull of the pixel centres.
        area_px2: area.
    """

    box_xyxy: Array
    hull: Array
    area_px2: float


@dataclass(frozen=True)
class MaskLabels:
    """What `label_outlines` returns; all arrays have N entries.

    Args:
        boxes_xyxy: (N, 4) rectified px.
        cc: (N,) c_c in [0, 1] by the chosen rule; NaN where not valid.
        candidates: (N, 2) c_c by the tangent on the box's left and right, clamped to [0, 1].
        valid: (N,) False where VPU does not lie above or below the mask, so that there are no tangents.
    """

    boxes_xyxy: Array
    cc: Array
    candidates: Array
    valid: NDArray[np.bool_]


def _as_uint8(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """Non-zero where the mask is; 256 and 0.5 are not to become 0."""
    if mask.dtype == np.uint8:
        return mask
    return (mask if mask.dtype == np.bool_ else mask != 0).view(np.uint8)


def mask_outline(mask: NDArray[Any], origin_px: tuple[int, int] = (0, 0)) -> Outline | None:
    """Outline of a mask (H, W), any non-zero value being set, whose first pixel is `origin_px`; None if empty."""
    image = _as_uint8(mask)
    x, y, w, h = cv2.boundingRect(image)
    if w == 0:
        return None
    inner = image[y : y + h, x : x + w]
    contours, _ = cv2.findContours(inner, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(contours) if len(contours) > 1 else contours[0])[:, 0]
    left, top = x + origin_px[0], y + origin_px[1]
    return Outline(
        np.array([left, top, left + w, top + h], dtype=np.float64),
        hull + np.array([left + 0.5, top + 0.5]),
        float(cv2.countNonZero(inner)),
    )


def rectified_outline(
    rectification: Rectification,
    mask: NDArray[Any],
    origin_px: tuple[int, int] = (0, 0),
    *,
    oversample: int = _OVERSAMPLE,
) -> Outline | None:
    """Outline, in rectified px, of a mask given in the frame; None where none of it lies in the rectified image.

    Args:
        rectification: from the frame in which the mask lies.
        mask: (h, w), any non-zero value being set, the part of the frame's mask that starts at `origin_px`.
        origin_px: frame px of the mask's first pixel.
        oversample: how many times finer than the rectified image the mask is sampled, at most; 1 is the
            published method, more lowers the error of c_c several times (docs/label-accuracy.md).
    """
    image: NDArray[Any] = _as_uint8(mask)
    x, y, width, height = cv2.boundingRect(image)
    if width == 0:
        return None
    image = cv2.threshold(image[y : y + height, x : x + width], 0, 255, cv2.THRESH_BINARY)[1]
    x, y = x + origin_px[0], y + origin_px[1]
    around = rectification.boxes(np.array([[x, y, x + width, y + height]], dtype=np.float64))[0]
    if not np.isfinite(around).all():
        around = np.array([0.0, 0.0, *rectification.size_wh])
    low = np.maximum(np.floor(around[:2]), 0).astype(int)
    size = np.minimum(np.ceil(around[2:]), rectification.size_wh).astype(int) - low
    if (size <= 0).any():
        return None
    fine = max(1, min(oversample, _LONGEST_SIDE // int(size.max())))
    to_patch = np.diag([fine, fine, 1.0]) @ translation(-low[0], -low[1]) @ rectification.matrix
    matrix = translation(-0.5, -0.5) @ to_patch @ translation(x + 0.5, y + 0.5)
    patch = cv2.warpPerspective(image, matrix, (int(size[0]) * fine, int(size[1]) * fine))
    outline = mask_outline(cv2.threshold(patch, 127, 255, cv2.THRESH_BINARY)[1])
    if outline is None:
        return None
    return Outline(outline.box_xyxy / fine + np.tile(low, 2), outline.hull / fine + low, outline.area_px2 / fine**2)


def label_outlines(outlines: Sequence[Outline], vpu: ArrayLike, rule: Rule = Rule.WIDER) -> MaskLabels:
    """Labels of N masks of one rectified image.

    Args:
        outlines: N outlines in the same rectified image.
        vpu: (2,) rectified px.
        rule: how to combine the two candidates.
    """
    rule = Rule(rule)
    u, v = (float(x) for x in np.asarray(vpu, dtype=np.float64))
    if not outlines:
        nothing = np.empty(0)
        return MaskLabels(np.empty((0, 4)), nothing, np.empty((0, 2)), np.empty(0, dtype=np.bool_))
    boxes = np.stack([outline.box_xyxy for outline in outlines])
    below = v > (boxes[:, 1] + boxes[:, 3]) / 2
    flip = np.where(below, -1.0, 1.0)
    y0, y1 = np.where(below, -boxes[:, 3], boxes[:, 1]), np.where(below, -boxes[:, 1], boxes[:, 3])
    valid = (flip * v < y0) & bool(np.isfinite([u, v]).all())

    # Tangents x = u + k (y - v): per mask the least and the greatest k, and how far below VPU they touch.
    slopes, depths = np.zeros((len(outlines), 2)), np.ones((len(outlines), 2))
    for i in np.flatnonzero(valid).tolist():
        depth = flip[i] * (outlines[i].hull[:, 1] - v)
        slope = (outlines[i].hull[:, 0] - u) / depth
        ends = [int(slope.argmin()), int(slope.argmax())]
        slopes[i], depths[i] = slope[ends], depth[ends]

    frame = (boxes[:, 0, None], y0[:, None], boxes[:, 2, None], y1[:, None], u, (flip * v)[:, None])
    raw, on_side = _candidates(slopes, *frame)
    height = (y1 - y0)[:, None]
    c = np.clip(raw, y0[:, None], y1[:, None])
    if rule is Rule.WIDER:
        chosen = c.min(axis=1)
    else:
        shift = _TANGENT_SHIFT * np.sqrt(1 + slopes**2) / depths
        ahead, _ = _candidates(slopes + shift, *frame, on_side=on_side, towards=slopes)
        behind, _ = _candidates(slopes - shift, *frame, on_side=on_side, towards=slopes)
        with np.errstate(invalid="ignore"):  # infinite only where not valid
            weight = 1 / np.maximum(np.abs(ahead - behind) / 2, 1e-6) ** 2
        # A weighted mean may leave its terms' range by a rounding error.
        chosen = np.clip((c * weight).sum(axis=1) / weight.sum(axis=1), c.min(axis=1), c.max(axis=1))
    # Back to shares of the box's height, measured from its top in the unflipped image.
    shares = (np.concatenate([c, chosen[:, None]], axis=1) - y0[:, None]) / height
    shares = np.where(below[:, None], 1 - shares, shares)
    shares[~valid] = np.nan
    return MaskLabels(boxes, shares[:, 2], shares[:, :2], valid)


def _candidates(
    slopes: Array,
    x0: Array,
    y0: Array,
    x1: Array,
    y1: Array,
    u: float,
    v: Array,
    *,
    on_side: NDArray[np.bool_] | None = None,
    towards: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """y of the top front edge by tangents of these slopes (N, 2); VPU lies above.

    `on_side` and `towards` keep the branch of other slopes, to measure how a candidate moves within it.
    """
    towards = slopes if towards is None else towards
    side = np.where(towards > 0, x1, x0)
    with np.errstate(divide="ignore", invalid="ignore"):
        at_side = v + (side - u) / np.where(np.abs(slopes) > 1e-12, slopes, 1e-12)
        corner = np.where(u < x0, x0, x1)
        at_bottom = v + (y0 - v) * slopes * (y1 - v) / np.where(corner == u, np.nan, corner - u)
    if on_side is None:
        # With VPU between the sides a tangent can only leave through a side; pixel borders may say otherwise.
        on_side = (at_side <= y1) | ((u >= x0) & (u <= x1))
    return np.where(on_side, at_side, at_bottom), on_side
