"""Labels from outlines: the 2D box and c_c of a vehicle from its mask.

Convention:
    Masks are (h, w), any non-zero value being set; pixel (x, y) covers [x, x + 1) x [y, y + 1). Points and hulls are
    (K, 2) float64 px as x, y, x right, y down; boxes (4,) as x0, y0, x1, y1; c_c lies in [0, 1].
    In a rectified mask the box follows pixel borders, and the tangents from VPU touch pixel centres. In a mask of the
    frame, box and tangents are oblique to the pixel grid; there a pixel counts as the square of half its side around
    its centre.

Source: Kocur & Ftacnik 2020, section 3.4 (tangents from VPU, the wider of the two candidates). The published method
rectifies the mask's pixels. `rectified_outline` rectifies the mask's hull, which rounds nothing to the rectified pixel
grid: that rounding is the largest part of the published method's error in c_c. `Rule.CONDITIONED` weights each
candidate by the inverse square of its displacement under a small shift of the tangent point: where a tangent runs
almost along a side of the box, half a pixel displaces the candidate far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.choices import Rule
from labelgen.errors import LabelgenError
from labelgen.geometry.homography import Array, bounding_boxes
from labelgen.geometry.rectification import Rectification

__all__ = [
    "MaskLabels",
    "RectifiedOutline",
    "label_outlines",
    "mask_outline",
    "mask_polygon",
    "polygon_outline",
    "rectified_outline",
]

_TANGENT_SHIFT_PX = 0.7
"""Shift of a tangent point by which the conditioned rule measures a candidate: about half the diagonal of a pixel."""
_MIDDLE_HALF = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])


@dataclass(frozen=True)
class RectifiedOutline:
    """The outline of one vehicle in the rectified image, all parts of its mask together.

    Args:
        box_xyxy: (4,) rectified px.
        hull: (K, 2) rectified px, points whose convex hull the tangents touch.
    """

    box_xyxy: Array
    hull: Array


@dataclass(frozen=True)
class MaskLabels:
    """Labels of N outlines.

    Args:
        boxes_xyxy: (N, 4) rectified px.
        cc: (N,) c_c in [0, 1] by the rule; NaN where not valid.
        candidates: (N, 2) c_c by the left and by the right tangent, clamped to [0, 1].
        valid: (N,) bool; False where VPU lies neither above nor below the box, so that no tangents exist.
    """

    boxes_xyxy: Array
    cc: Array
    candidates: Array
    valid: NDArray[np.bool_]


def _as_uint8(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the mask as uint8, non-zero where it is set; a plain cast would turn 256 and 0.5 into 0."""
    if mask.dtype == np.uint8:
        return mask
    return (mask if mask.dtype == np.bool_ else mask != 0).view(np.uint8)


def _hull(mask: NDArray[Any], origin_px: tuple[int, int]) -> Array | None:
    """Return the convex hull (K, 2) of the mask's pixel indices, all parts together; None for an empty mask."""
    contours, _ = cv2.findContours(_as_uint8(mask), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not contours:
        return None
    points = np.concatenate(contours) if len(contours) > 1 else contours[0]
    return np.asarray(cv2.convexHull(points)[:, 0] + np.asarray(origin_px), dtype=np.float64)


def mask_outline(mask: NDArray[Any], origin_px: tuple[int, int] = (0, 0)) -> RectifiedOutline | None:
    """Return the outline of a mask of the rectified image (the published method).

    Args:
        mask: (h, w), any non-zero value being set.
        origin_px: rectified px of its first pixel.

    Returns:
        The outline; None for an empty mask.
    """
    hull = _hull(mask, origin_px)
    if hull is None:
        return None
    return RectifiedOutline(np.concatenate([hull.min(axis=0), hull.max(axis=0) + 1]), hull + 0.5)


def rectified_outline(
    rectification: Rectification, mask: NDArray[Any], origin_px: tuple[int, int] = (0, 0)
) -> RectifiedOutline | None:
    """Return the outline, in the rectified image, of a mask of the frame.

    Args:
        rectification: of the frame.
        mask: (h, w), any non-zero value being set, the part of the frame's mask that starts at `origin_px`.
        origin_px: frame px of the mask's first pixel.

    Returns:
        The outline; None where the mask is empty or lies outside the rectified image.
    """
    polygon = mask_polygon(mask, origin_px)
    return None if polygon is None else polygon_outline(rectification, polygon)


def mask_polygon(mask: NDArray[Any], origin_px: tuple[int, int] = (0, 0)) -> Array | None:
    """Return points (K, 2), frame px, whose convex hull stands for a mask of the frame.

    Args:
        mask: (h, w), any non-zero value being set, the part of the frame's mask that starts at `origin_px`.
        origin_px: frame px of the mask's first pixel.

    Returns:
        The points; None for an empty mask.
    """
    hull = _hull(mask, origin_px)
    if hull is None:
        return None
    out: Array = (hull[:, None] + _MIDDLE_HALF).reshape(-1, 2)
    return out


def polygon_outline(rectification: Rectification, points: Array) -> RectifiedOutline | None:
    """Return the outline, in the rectified image, of the convex hull of frame points.

    Args:
        rectification: of the frame.
        points: (K, 2) frame px.

    Returns:
        The outline; None where it lies outside the rectified image or has no area there.
    """
    inside = rectification.points(points)
    if not ((inside >= 0) & (inside <= rectification.size_wh)).all():  # NaN, beyond the horizon, is outside
        outer = cv2.convexHull(points.astype(np.float32))[:, 0]
        inside = rectification.polygon_inside(outer)
        if len(inside) == 0:
            return None
    box = bounding_boxes(inside)
    return RectifiedOutline(box, inside) if (box[:2] < box[2:]).all() else None


def label_outlines(outlines: Sequence[RectifiedOutline], vpu: ArrayLike, rule: Rule = Rule.WIDER) -> MaskLabels:
    """Label N outlines of one rectified image: 2D boxes and c_c from the tangents through VPU.

    Args:
        outlines: the N outlines.
        vpu: (2,) rectified px, the vanishing point that the rectification leaves finite.
        rule: how the two candidates become one c_c; not `Rule.FITTED`.

    Raises:
        LabelgenError: a rule that does not rest on tangents.
    """
    rule = Rule(rule)
    if not rule.is_of_tangents:
        raise LabelgenError(f"rule {rule}: it needs the masks of whole passages; choose another", parameter="rule")
    u, v = (float(x) for x in np.asarray(vpu, dtype=np.float64))
    if not outlines:
        return MaskLabels(np.empty((0, 4)), np.empty(0), np.empty((0, 2)), np.empty(0, dtype=np.bool_))
    boxes = np.stack([outline.box_xyxy for outline in outlines])
    below = v > (boxes[:, 1] + boxes[:, 3]) / 2
    flip = np.where(below, -1.0, 1.0)
    y0, y1 = np.where(below, -boxes[:, 3], boxes[:, 1]), np.where(below, -boxes[:, 1], boxes[:, 3])
    valid = (flip * v < y0) & bool(np.isfinite([u, v]).all())

    # Tangents x = u + k (y - v): per outline the least and the greatest k, and the depth below VPU where they touch.
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
        combined = c.min(axis=1)
    else:
        shift = _TANGENT_SHIFT_PX * np.sqrt(1 + slopes**2) / depths
        ahead, _ = _candidates(slopes + shift, *frame, on_side=on_side, towards=slopes)
        behind, _ = _candidates(slopes - shift, *frame, on_side=on_side, towards=slopes)
        with np.errstate(invalid="ignore"):  # infinite only where not valid
            weight = 1 / np.maximum(np.abs(ahead - behind) / 2, 1e-6) ** 2
        # A weighted mean may leave its terms' range by a rounding error.
        combined = np.clip((c * weight).sum(axis=1) / weight.sum(axis=1), c.min(axis=1), c.max(axis=1))
    # Back to shares of the box's height, measured from its top in the unflipped image.
    shares = (np.concatenate([c, combined[:, None]], axis=1) - y0[:, None]) / height
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
    """Return the y (N, 2) of the top front edge by tangents of slopes (N, 2), and which leave through a side.

    VPU lies above the box. With `on_side` and `towards` of other slopes the branch of those is kept, which measures
    how a candidate moves within it.
    """
    towards = slopes if towards is None else towards
    side = np.where(towards > 0, x1, x0)
    with np.errstate(divide="ignore", invalid="ignore"):
        at_side = v + (side - u) / np.where(np.abs(slopes) > 1e-12, slopes, 1e-12)
        corner = np.where(u < x0, x0, x1)
        at_bottom = v + (y0 - v) * slopes * (y1 - v) / np.where(corner == u, np.nan, corner - u)
    if on_side is None:
        # With VPU between the sides every tangent leaves through a side, even where pixel borders contradict.
        on_side = (at_side <= y1) | ((u >= x0) & (u <= x1))
    return np.where(on_side, at_side, at_bottom), on_side
