"""Labels of a rectified frame from its instance masks, with a reason for every mask that gives none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.choices import Rule
from labelgen.geometry.box_codec import decode_boxes, front_bottom_midpoints
from labelgen.geometry.boxes import covered_share
from labelgen.geometry.camera import Camera
from labelgen.geometry.cuboid import cuboid_sizes
from labelgen.geometry.homography import Array
from labelgen.geometry.outline_label import RectifiedOutline, label_outlines, rectified_outline
from labelgen.geometry.rectification import Rectification
from labelgen.labels import Flag, IgnoredBoxes, IgnoreReason, Labels
from labelgen.masks import InstanceMasks

__all__ = ["LABEL_LIMITS", "FrameLabels", "LabelLimits", "MaskReject", "flat_labels", "label_masks"]


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


class _Rejections:
    """The masks of a frame that gave no label, with the boxes to ignore in their place.

    Args:
        size_wh: of the rectified frame, px.
        limits: thresholds.
    """

    def __init__(self, size_wh: tuple[int, int], limits: LabelLimits) -> None:
        self._border = np.array([0, 0, *size_wh], dtype=np.float64)
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
            margin = self._limits.part_margin * np.tile(box_xyxy[2:] - box_xyxy[:2], 2)
            box_xyxy = np.clip(
                box_xyxy + margin * (-1, -1, 1, 1), self._border[[0, 1, 0, 1]], self._border[[2, 3, 2, 3]]
            )
        self._boxes.append((number, box_xyxy, ignore_reason))

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


def label_masks(
    masks: InstanceMasks,
    rectification: Rectification,
    camera: Camera,
    road: NDArray[np.bool_],
    rule: Rule = Rule.WIDER,
    limits: LabelLimits = LABEL_LIMITS,
) -> FrameLabels:
    """Label the vehicles of one frame.

    Args:
        masks: instance masks of the frame.
        rectification: of the frame.
        camera: of the frame; without a scale, sizes in metres are not tested.
        road: (H, W) bool road mask of the frame.
        rule: how the two candidates become one c_c.
        limits: thresholds.

    Returns:
        Labels of the rectified frame, a reject for each mask without a label, and the boxes to ignore.
    """
    rejections = _Rejections(rectification.size_wh, limits)
    doubled = _doubled(masks, limits)
    outlines = _large_outlines(masks, rectification, doubled, limits, rejections)
    if not outlines:
        return rejections.result(Labels.empty())
    index = np.array(list(outlines))
    mask_labels = label_outlines(list(outlines.values()), rectification.vpu, rule)
    # Shards store float32, so the label is what can be decoded from float32.
    boxes = mask_labels.boxes_xyxy.astype(np.float32).astype(np.float64)
    cc = np.clip(mask_labels.cc, 0, 1).astype(np.float32).astype(np.float64)
    vertices, valid = decode_boxes(boxes, cc, rectification.vpu)
    valid &= mask_labels.valid
    cut = _truncated(boxes, rectification.size_wh, limits.border_px) | _at_frame_border(masks, limits)[index]
    on_road = _on_road(
        masks, index, road, rectification.points_back(front_bottom_midpoints(vertices)), limits.min_on_road
    )
    bad_size, sizes = _implausible(vertices, rectification, camera, limits)
    keep = np.ones(len(index), dtype=np.bool_)
    for j, i in enumerate(index.tolist()):
        reason = None
        if not valid[j]:
            reason = ("no valid 3D box", f"c_c {cc[j]:.3f}" if mask_labels.valid[j] else "VPU lies within its height")
        elif not on_road[j]:
            reason = ("off the road", "")
        elif bad_size[j] and not cut[j]:
            reason = ("implausible size", "length x width x height {:.1f} x {:.1f} x {:.1f} m".format(*sizes[j]))
        if reason:
            is_part = reason[0] == IgnoreReason.IMPLAUSIBLE_SIZE.text and (sizes[j] < limits.min_size_lwh_m).any()
            rejections.add_box(i, *reason, boxes[j], is_cut=bool(cut[j]), is_part=bool(is_part))
            keep[j] = False
    disagree = np.abs(np.diff(mask_labels.candidates, axis=1))[:, 0] > limits.max_candidate_difference
    flags = (
        Flag.TRUNCATED * cut + Flag.CANDIDATES_DISAGREE * disagree + Flag.TOUCHING * _touching(masks, doubled)[index]
    )
    labels = Labels(
        boxes[keep],
        cc[keep],
        masks.class_ids[index][keep],
        masks.scores[index][keep],
        flags[keep].astype(np.uint16),
        mask_labels.candidates[keep],
    )
    return rejections.result(labels)


def _large_outlines(
    masks: InstanceMasks,
    rectification: Rectification,
    doubled: NDArray[np.bool_],
    limits: LabelLimits,
    rejections: _Rejections,
) -> dict[int, RectifiedOutline]:
    """Return the outlines of masks that are high enough for a label, by the masks' numbers; reject the others."""
    outlines: dict[int, RectifiedOutline] = {}
    at_border = _at_frame_border(masks, limits)
    for i, (crop, origin) in enumerate(zip(masks.crops, masks.origins.tolist(), strict=True)):
        outline = rectified_outline(rectification, crop, (origin[0], origin[1]))
        box = None if outline is None else outline.box_xyxy
        if doubled[i]:
            rejections.add_second(i, box)
        elif outline is None or box is None:
            rejections.add(i, "outside the rectified image")
        elif (height := box[3] - box[1]) < limits.min_height_px:
            is_cut = at_border[i] or _truncated(box[None], rectification.size_wh, limits.border_px)[0]
            rejections.add_box(i, *_too_small(height, limits), box, is_cut=bool(is_cut), is_part=True)
        else:
            outlines[i] = outline
    return outlines


def flat_labels(
    masks: InstanceMasks,
    rectification: Rectification,
    road: NDArray[np.bool_],
    limits: LabelLimits = LABEL_LIMITS,
) -> FrameLabels:
    """Label the vehicles of one frame that is resized but not rectified: 2D boxes without c_c, with `Flag.FLAT`.

    Args:
        masks: instance masks of the frame.
        rectification: the resizing, `Rectification.of_region(Region.NONE, ...)`.
        road: (H, W) bool road mask of the frame.
        limits: thresholds; sizes in metres are not tested.

    Returns:
        Labels of the resized frame, a reject for each mask without a label, and the boxes to ignore.
    """
    rejections = _Rejections(rectification.size_wh, limits)
    boxes, numbers = [], []
    doubled, at_border = _doubled(masks, limits), _at_frame_border(masks, limits)
    for i, box in enumerate(rectification.boxes(masks.boxes_xyxy) if len(masks) else []):
        if doubled[i]:
            rejections.add_second(i, box)
            continue
        contact_point = rectification.points_back([[(box[0] + box[2]) / 2, box[3]]])
        if (height := box[3] - box[1]) < limits.min_height_px:
            rejections.add_box(i, *_too_small(height, limits), box, is_cut=bool(at_border[i]), is_part=True)
        elif not _on_road(masks, np.array([i]), road, contact_point, limits.min_on_road)[0]:
            rejections.add_box(i, "off the road", "", box, is_cut=bool(at_border[i]))
        else:
            boxes.append(box)
            numbers.append(i)
    if not numbers:
        return rejections.result(Labels.empty())
    index = np.array(numbers)
    flags = Flag.FLAT + Flag.TRUNCATED * at_border[index] + Flag.TOUCHING * _touching(masks, doubled)[index]
    zeros = np.zeros(len(numbers))
    labels = Labels(np.array(boxes), zeros, masks.class_ids[index], masks.scores[index], flags.astype(np.uint16))
    return rejections.result(labels)


def _too_small(height: float, limits: LabelLimits) -> tuple[str, str]:
    return "too small", f"{height:.1f} px high, at least {limits.min_height_px:g} wanted"


def _truncated(boxes: Array, size_wh: tuple[int, int], border_px: float) -> NDArray[np.bool_]:
    low = (boxes[:, :2] < border_px).any(axis=1)
    high = (boxes[:, 2:] > np.asarray(size_wh) - border_px).any(axis=1)
    return np.asarray(low | high)


def _doubled(masks: InstanceMasks, limits: LabelLimits) -> NDArray[np.bool_]:
    """Return (N,) which predicted masks are second masks of the same vehicle."""
    return masks.inside_better(limits.min_inside) if masks.are_predicted else np.zeros(len(masks), dtype=np.bool_)


def _at_frame_border(masks: InstanceMasks, limits: LabelLimits) -> NDArray[np.bool_]:
    """Return which of N masks (N,) the border of the frame cuts."""
    margin = limits.border_share * np.asarray(masks.frame_wh) if masks.are_predicted else np.zeros(2)
    low, high = masks.boxes_xyxy[:, :2], masks.boxes_xyxy[:, 2:]
    return np.asarray((low <= margin).any(axis=1) | (high >= np.asarray(masks.frame_wh) - margin).any(axis=1))


def _on_road(
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


def _implausible(
    vertices: Array, rectification: Rectification, camera: Camera, limits: LabelLimits
) -> tuple[NDArray[np.bool_], Array]:
    if camera.scale is None:
        return np.zeros(len(vertices), dtype=np.bool_), np.full((len(vertices), 3), np.nan)
    sizes = cuboid_sizes(rectification.points_back(vertices), camera)
    with np.errstate(invalid="ignore"):
        bad = np.asarray(~((sizes >= limits.min_size_lwh_m) & (sizes <= limits.max_size_lwh_m)).all(axis=1))
    return bad, sizes


def _touching(masks: InstanceMasks, doubled: NDArray[np.bool_]) -> NDArray[np.bool_]:
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
