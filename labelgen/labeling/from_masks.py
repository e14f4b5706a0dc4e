"""Labels of a rectified frame from its instance masks, with a reason for every mask that gives none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labelgen.choices import Rule
from labelgen.geometry.box_codec import decode_boxes, front_bottom_midpoints
from labelgen.geometry.camera import Camera
from labelgen.geometry.cuboid import cuboid_sizes
from labelgen.geometry.homography import Array
from labelgen.geometry.outline_label import label_outlines
from labelgen.geometry.rectification import Rectification
from labelgen.labeling.screening import (
    LABEL_LIMITS,
    STANDS,
    FrameLabels,
    LabelLimits,
    MaskReject,
    Rejections,
    at_frame_border,
    large_outlines,
    on_road,
    second_masks,
    too_small,
    touching,
    truncated,
)
from labelgen.labels import Flag, IgnoreReason, Labels
from labelgen.masks import InstanceMasks

__all__ = ["LABEL_LIMITS", "FrameLabels", "LabelLimits", "MaskReject", "flat_labels", "label_masks"]


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
    rejections = Rejections(rectification.size_wh, limits)
    doubled = second_masks(masks, limits)
    outlines = large_outlines(masks, rectification, doubled, limits, rejections)
    if not outlines:
        return rejections.result(Labels.empty())
    index = np.array(list(outlines))
    mask_labels = label_outlines(list(outlines.values()), rectification.vpu, rule)
    # Shards store float32, so the label is what can be decoded from float32.
    boxes = mask_labels.boxes_xyxy.astype(np.float32).astype(np.float64)
    cc = np.clip(mask_labels.cc, 0, 1).astype(np.float32).astype(np.float64)
    vertices, valid = decode_boxes(boxes, cc, rectification.vpu)
    valid &= mask_labels.valid
    cut = truncated(boxes, rectification.size_wh, limits.border_px) | at_frame_border(masks, limits)[index]
    is_on_road = on_road(
        masks, index, road, rectification.points_back(front_bottom_midpoints(vertices)), limits.min_on_road
    )
    bad_size, sizes = _implausible(vertices, rectification, camera, limits)
    keep = np.ones(len(index), dtype=np.bool_)
    for j, i in enumerate(index.tolist()):
        reason = None
        if not valid[j]:
            reason = ("no valid 3D box", f"c_c {cc[j]:.3f}" if mask_labels.valid[j] else "VPU lies within its height")
        elif not is_on_road[j]:
            reason = ("off the road", "")
        elif bad_size[j] and not cut[j]:
            reason = ("implausible size", "length x width x height {:.1f} x {:.1f} x {:.1f} m".format(*sizes[j]))
        if reason:
            is_part = reason[0] == IgnoreReason.IMPLAUSIBLE_SIZE.text and (sizes[j] < limits.min_size_lwh_m).any()
            rejections.add_box(i, *reason, boxes[j], is_cut=bool(cut[j]), is_part=bool(is_part))
            keep[j] = False
    disagree = np.abs(np.diff(mask_labels.candidates, axis=1))[:, 0] > limits.max_candidate_difference
    flags = Flag.TRUNCATED * cut + Flag.CANDIDATES_DISAGREE * disagree + Flag.TOUCHING * touching(masks, doubled)[index]
    labels = Labels(
        boxes[keep],
        cc[keep],
        masks.class_ids[index][keep],
        masks.scores[index][keep],
        flags[keep].astype(np.uint16),
        mask_labels.candidates[keep],
    )
    return rejections.result(labels)


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
    rejections = Rejections(rectification.size_wh, limits)
    boxes, numbers = [], []
    doubled, at_border = second_masks(masks, limits), at_frame_border(masks, limits)
    for i, box in enumerate(rectification.boxes(masks.boxes_xyxy) if len(masks) else []):
        if doubled[i]:
            rejections.add_second(i, box)
            continue
        if masks.moving is not None and not masks.moving[i]:
            rejections.add_box(i, STANDS, "", box, is_cut=False)
            continue
        contact_point = rectification.points_back([[(box[0] + box[2]) / 2, box[3]]])
        if (height := box[3] - box[1]) < limits.min_height_px:
            rejections.add_box(i, *too_small(height, limits), box, is_cut=bool(at_border[i]), is_part=True)
        elif not on_road(masks, np.array([i]), road, contact_point, limits.min_on_road)[0]:
            rejections.add_box(i, "off the road", "", box, is_cut=bool(at_border[i]))
        else:
            boxes.append(box)
            numbers.append(i)
    if not numbers:
        return rejections.result(Labels.empty())
    index = np.array(numbers)
    flags = Flag.FLAT + Flag.TRUNCATED * at_border[index] + Flag.TOUCHING * touching(masks, doubled)[index]
    zeros = np.zeros(len(numbers))
    labels = Labels(np.array(boxes), zeros, masks.class_ids[index], masks.scores[index], flags.astype(np.uint16))
    return rejections.result(labels)


def _implausible(
    vertices: Array, rectification: Rectification, camera: Camera, limits: LabelLimits
) -> tuple[NDArray[np.bool_], Array]:
    if camera.scale is None:
        return np.zeros(len(vertices), dtype=np.bool_), np.full((len(vertices), 3), np.nan)
    sizes = cuboid_sizes(rectification.points_back(vertices), camera)
    with np.errstate(invalid="ignore"):
        bad = np.asarray(~((sizes >= limits.min_size_lwh_m) & (sizes <= limits.max_size_lwh_m)).all(axis=1))
    return bad, sizes
