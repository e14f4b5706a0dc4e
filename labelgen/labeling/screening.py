"""What labels from masks have in common: thresholds, masks that give none, and tests of place and size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.boxes import covered_share
from labelgen.geometry.homography import Array
from labelgen.geometry.outline_label import RectifiedOutline, rectified_outline
from labelgen.geometry.rectification import Rectification
from labelgen.labels import IgnoredBoxes, IgnoreReason, Labels
from labelgen.masks import InstanceMasks

__all__ = [
    "LABEL_LIMITS",
    "STANDS",
    "FrameLabels",
    "LabelLimits",
    "MaskReject",
    "Rejections",
    "at_frame_border",
    "large_outlines",
    "on_road",
    "second_masks",
    "too_small",
    "touching",
    "truncated",
]


@dataclass(frozen=True)
class LabelLimits:
    """Thresholds for labels from masks."""

    min_height_px: float = 10.0
    """Least height of the rectified box, px: in lower boxes half a pixel is too large a share of c_c."""
    min_on_road: float = 0.25
    """Least share of the mask on the road mask, unless the contact point lies on it. More loses tall vehicles at the
    road's edge, less keeps parked ones beside it."""
    min_size_lwh_m: tuple[float, float, float] = (1.2, 0.5, 0.6)
    """Least length, width and height of the 3D box, metres: refuses people. Wide, as calibrations made by hand may be
    wrong by a third."""
    max_size_lwh_m: tuple[float, float, float] = (30.0, 4.5, 6.0)
    """Largest length, width and height of the 3D box, metres: refuses several vehicles in one mask."""
    max_candidate_difference: float = 0.1
    """Largest difference of the two candidates for c_c that is not flagged: more, and the outline is not a box's."""
    min_inside: float = 0.8
    """Least share of a predicted mask inside one of a higher score that makes it a second mask of the same vehicle.
    Less loses vehicles that are half hidden. Its box is ignored unless another box covers as large a share of it."""
    part_margin: float = 0.5
    """Share of its size by which the ignored box of a mask that is lower or smaller than a label's is widened on each
    side: it often shows a part of a vehicle. Less leaves vehicles that lost 60 % of their mask as background."""
    border_share: float = 0.01
    """A predicted mask that ends within this share of the frame's side is cut by it: networks end short of it."""
    border_px: float = 1.0
    """A box that ends less than this inside the rectified image's border is flagged as truncated, px."""


LABEL_LIMITS = LabelLimits()
STANDS = "does not move"
"""Reason of rejects that are no traffic, see `InstanceMasks.moving`."""
MaskReject = tuple[int, str, str]
"""Number of the mask in its frame, reason, detail."""


class FrameLabels(NamedTuple):
    """What the masks of one frame give.

    Args:
        labels: of the rectified frame.
        rejects: one for each mask without a label, in the order of the masks.
        ignored: boxes of these masks in the rectified frame, where they have one: the vehicles are still in the image.
    """

    labels: Labels
    rejects: list[MaskReject]
    ignored: IgnoredBoxes


class Rejections:
    """The masks of a frame that gave no label, with the boxes to ignore in their place.

    Args:
        size_wh: of the rectified frame, px.
        limits: thresholds.
    """

    def __init__(self, size_wh: tuple[int, int], limits: LabelLimits) -> None:
        self._size = np.array(size_wh, dtype=np.float64)
        self._limits = limits
        self._rejects: list[MaskReject] = []
        self._boxes: list[tuple[int, Array, IgnoreReason]] = []
        self._second: list[tuple[int, Array]] = []

    def add(self, number: int, reason: str, detail: str = "") -> None:
        """Reject a mask that has no box in the rectified frame."""
        self._rejects.append((number, reason, detail))

    def add_box(
        self, number: int, reason: str, detail: str, box_xyxy: Array, *, is_cut: bool, is_part: bool = False
    ) -> None:
        """Reject a mask; its box (4,), rectified px, is ignored.

        Args:
            number: of the mask.
            reason, detail: of the reject.
            box_xyxy: (4,) of the mask.
            is_cut: whether the border cuts the mask: its true height and box are unknown then.
            is_part: whether the mask is so small that it may show a part of a vehicle.
        """
        self.add(number, reason, detail)
        ignore_reason = IgnoreReason.of_reject(reason)
        if is_cut and ignore_reason in (IgnoreReason.TOO_SMALL, IgnoreReason.NO_3D_BOX):
            ignore_reason = IgnoreReason.CUT
        if is_part:
            box_xyxy = self._widened(box_xyxy)
        self._boxes.append((number, box_xyxy, ignore_reason))

    def _widened(self, box_xyxy: Array) -> Array:
        """Return a box (4,) with the margin of parts; what the border takes of it is added on the other side."""
        size = box_xyxy[2:] - box_xyxy[:2]
        # At least as large as a label: anchors are not smaller, and half of one must lie in the box.
        margin = np.maximum(self._limits.part_margin * size, (self._limits.min_height_px - size) / 2)
        low, high = box_xyxy[:2] - margin, box_xyxy[2:] + margin
        beyond_low, beyond_high = np.maximum(-low, 0), np.maximum(high - self._size, 0)
        return np.concatenate([np.maximum(low - beyond_high, 0), np.minimum(high + beyond_low, self._size)])

    def add_second(self, number: int, box_xyxy: Array | None) -> None:
        """Reject a second mask of a vehicle; its box is ignored if nothing else covers it."""
        self.add(number, "inside a better mask")
        if box_xyxy is not None:
            self._second.append((number, box_xyxy))

    def result(self, labels: Labels) -> FrameLabels:
        """Return all that the frame gives."""
        boxes = list(self._boxes)
        # The better mask may have a label, a box to ignore, or be a second mask itself.
        for number, box in self._second:
            covering = np.concatenate([labels.boxes_xyxy, *(other[None] for _, other, _ in boxes)])
            if not (covered_share([box], covering) >= self._limits.min_inside).any():
                boxes.append((number, box, IgnoreReason.OTHER))
        boxes.sort(key=lambda item: item[0])
        # Shards store float32, in which a box of no width may come out.
        array = np.array([box for _, box, _ in boxes], dtype=np.float32).reshape(-1, 4).astype(np.float64)
        reasons = np.array([int(reason) for _, _, reason in boxes], dtype=np.uint8)
        solid = (array[:, :2] < array[:, 2:]).all(axis=1)
        return FrameLabels(labels, sorted(self._rejects), IgnoredBoxes(array[solid], reasons[solid]))


def large_outlines(
    masks: InstanceMasks,
    rectification: Rectification,
    doubled: NDArray[np.bool_],
    limits: LabelLimits,
    rejections: Rejections,
) -> dict[int, RectifiedOutline]:
    """Return the outlines of masks that move and are high enough for a label, by their numbers; reject the others."""
    outlines: dict[int, RectifiedOutline] = {}
    at_border = at_frame_border(masks, limits)
    for i, (crop, origin) in enumerate(zip(masks.crops, masks.origins.tolist(), strict=True)):
        outline = rectified_outline(rectification, crop, (origin[0], origin[1]))
        box = None if outline is None else outline.box_xyxy
        if doubled[i]:
            rejections.add_second(i, box)
        elif outline is None or box is None:
            rejections.add(i, "outside the rectified image")
        elif masks.moving is not None and not masks.moving[i]:
            rejections.add_box(i, STANDS, "", box, is_cut=False)
        elif (height := box[3] - box[1]) < limits.min_height_px:
            is_cut = at_border[i] or truncated(box[None], rectification.size_wh, limits.border_px)[0]
            rejections.add_box(i, *too_small(height, limits), box, is_cut=bool(is_cut), is_part=True)
        else:
            outlines[i] = outline
    return outlines


def too_small(height: float, limits: LabelLimits) -> tuple[str, str]:
    return "too small", f"{height:.1f} px high, at least {limits.min_height_px:g} wanted"


def truncated(boxes: Array, size_wh: tuple[int, int], border_px: float) -> NDArray[np.bool_]:
    low = (boxes[:, :2] < border_px).any(axis=1)
    high = (boxes[:, 2:] > np.asarray(size_wh) - border_px).any(axis=1)
    return np.asarray(low | high)


def second_masks(masks: InstanceMasks, limits: LabelLimits) -> NDArray[np.bool_]:
    """Return (N,) which predicted masks are second masks of the same vehicle."""
    return masks.inside_better(limits.min_inside) if masks.are_predicted else np.zeros(len(masks), dtype=np.bool_)


def at_frame_border(masks: InstanceMasks, limits: LabelLimits) -> NDArray[np.bool_]:
    """Return which of N masks (N,) the border of the frame cuts."""
    margin = limits.border_share * np.asarray(masks.frame_wh) if masks.are_predicted else np.zeros(2)
    low, high = masks.boxes_xyxy[:, :2], masks.boxes_xyxy[:, 2:]
    return np.asarray((low <= margin).any(axis=1) | (high >= np.asarray(masks.frame_wh) - margin).any(axis=1))


def on_road(
    masks: InstanceMasks, index: NDArray[np.int64], road: NDArray[np.bool_], contact_points_px: Array, min_share: float
) -> NDArray[np.bool_]:
    """Return which boxes have their contact point, or enough of their mask, on the road."""
    out = np.zeros(len(index), dtype=np.bool_)
    height, width = road.shape
    for j, i in enumerate(index.tolist()):
        (x, y), crop = masks.origins[i].tolist(), masks.crops[i]
        share = road[y : y + crop.shape[0], x : x + crop.shape[1]][crop].mean()
        cx, cy = contact_points_px[j] if np.isfinite(contact_points_px[j]).all() else (-1.0, -1.0)
        inside = 0 <= cx < width and 0 <= cy < height
        out[j] = share >= min_share or (inside and road[int(cy), int(cx)])
    return out


def touching(masks: InstanceMasks, doubled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of N masks (N,) touch another vehicle's; second masks of a vehicle count for none."""
    n = len(masks)
    out = np.zeros(n, dtype=np.bool_)
    low = masks.origins.reshape(-1, 2)
    high = low + np.array([crop.shape[::-1] for crop in masks.crops], dtype=np.int64).reshape(-1, 2)
    near = (low[:, None] <= high[None] + 1).all(-1) & (low[None] <= high[:, None] + 1).all(-1)
    near &= ~doubled[:, None] & ~doubled[None]
    for a, b in zip(*np.nonzero(np.triu(near, 1)), strict=True):
        x0, y0 = np.minimum(low[a], low[b]).tolist()
        x1, y1 = np.maximum(high[a], high[b]).tolist()
        first, second = (_paste(masks, i, (x0 - 1, y0 - 1, x1 + 1, y1 + 1)) for i in (a, b))
        if np.logical_and(cv2.dilate(first, np.ones((3, 3), np.uint8)), second).any():
            out[[a, b]] = True
    return out


def _paste(masks: InstanceMasks, i: int, window: Sequence[int]) -> NDArray[np.uint8]:
    """Return one mask on a canvas that covers a window x0, y0, x1, y1 of the frame."""
    canvas = np.zeros((window[3] - window[1], window[2] - window[0]), dtype=np.uint8)
    (x, y), crop = masks.origins[i].tolist(), masks.crops[i]
    canvas[y - window[1] : y - window[1] + crop.shape[0], x - window[0] : x - window[0] + crop.shape[1]] = crop
    return canvas
