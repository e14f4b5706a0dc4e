"""Instance masks of one frame -> labels of the rectified frame, with a reason for every mask that gives none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.choices import Rule
from labelgen.geometry.box_codec import decode_boxes, front_bottom_midpoints
from labelgen.geometry.camera import Camera
from labelgen.geometry.cuboid import cuboid_sizes
from labelgen.geometry.homography import Array
from labelgen.geometry.outline_label import RectifiedOutline, label_outlines, rectified_outline
from labelgen.geometry.rectification import Rectification
from labelgen.labels import Flag, Labels
from labelgen.masks import InstanceMasks

__all__ = ["LABEL_LIMITS", "LabelLimits", "MaskReject", "flat_labels", "label_masks"]

_DISAGREE = 0.1
_BORDER_PX = 1.0


@dataclass(frozen=True)
class LabelLimits:
    """What a mask must be to become a label.

    Args:
        min_height_px: least height of the rectified box: below it, half a pixel is too much of c_c.
        min_on_road: least share of the mask that lies on the road mask, unless its foot does.
        least_m, most_m: bounds for length, width and height of the 3D box, metres. Wide, because a calibration
            by hand may be off by a third; they are there to refuse people, and several vehicles in one mask.
    """

    min_height_px: float = 10.0
    min_on_road: float = 0.25
    least_m: tuple[float, float, float] = (1.2, 0.5, 0.6)
    most_m: tuple[float, float, float] = (30.0, 4.5, 6.0)


LABEL_LIMITS = LabelLimits()
MaskReject = tuple[int, str, str]
"""Number of the mask, reason, detail."""


def label_masks(
    masks: InstanceMasks,
    rectification: Rectification,
    camera: Camera,
    road: NDArray[np.bool_],
    rule: Rule = Rule.WIDER,
    limits: LabelLimits = LABEL_LIMITS,
) -> tuple[Labels, list[MaskReject]]:
    """Label the vehicles of one frame.

    Args:
        masks: instance masks in the frame.
        rectification: of the frame.
        camera: for sizes in metres; without a scale they are not judged.
        road: (H, W) road mask.
        rule: how c_c's two candidates become one.
        limits: what to refuse.

    Returns:
        labels, and a reject for each mask that is not among them.
    """
    rejects: list[MaskReject] = []
    outlines: list[RectifiedOutline] = []
    numbers: list[int] = []
    for i, (crop, origin) in enumerate(zip(masks.crops, masks.origins.tolist(), strict=True)):
        outline = rectified_outline(rectification, crop, (origin[0], origin[1]))
        if outline is None:
            rejects.append((i, "outside the rectified image", ""))
        elif (height := outline.box_xyxy[3] - outline.box_xyxy[1]) < limits.min_height_px:
            rejects.append((i, *_too_small(height, limits)))
        else:
            outlines.append(outline)
            numbers.append(i)
    if not numbers:
        return Labels.empty(), rejects
    index = np.array(numbers)
    found = label_outlines(outlines, rectification.vpu, rule)
    # Judge what will be stored: float32.
    boxes = found.boxes_xyxy.astype(np.float32).astype(np.float64)
    cc = np.clip(found.cc, 0, 1).astype(np.float32).astype(np.float64)
    vertices, valid = decode_boxes(boxes, cc, rectification.vpu)
    valid &= found.valid
    cut = _truncated(boxes, rectification.size_wh) | _at_frame_border(masks, index)
    on_road = _on_road(
        masks, index, road, rectification.points_back(front_bottom_midpoints(vertices)), limits.min_on_road
    )
    bad_size, sizes = _implausible(vertices, rectification, camera, limits)
    keep = np.ones(len(index), dtype=np.bool_)
    for j, i in enumerate(numbers):
        reason = None
        if not valid[j]:
            reason = ("no valid 3D box", f"c_c {cc[j]:.3f}" if found.valid[j] else "VPU lies within its height")
        elif not on_road[j]:
            reason = ("off the road", "")
        elif bad_size[j] and not cut[j]:
            reason = ("implausible size", "length x width x height {:.1f} x {:.1f} x {:.1f} m".format(*sizes[j]))
        if reason:
            rejects.append((i, *reason))
            keep[j] = False
    disagree = np.abs(np.diff(found.candidates, axis=1))[:, 0] > _DISAGREE
    flags = Flag.TRUNCATED * cut + Flag.CANDIDATES_DISAGREE * disagree + Flag.TOUCHING * _touching(masks)[index]
    labels = Labels(
        boxes[keep],
        cc[keep],
        masks.class_ids[index][keep],
        masks.scores[index][keep],
        flags[keep].astype(np.uint16),
        found.candidates[keep],
    )
    return labels, sorted(rejects)


def flat_labels(
    masks: InstanceMasks,
    rectification: Rectification,
    road: NDArray[np.bool_],
    limits: LabelLimits = LABEL_LIMITS,
) -> tuple[Labels, list[MaskReject]]:
    """Label the vehicles of one frame that is resized but not rectified: 2D boxes with `Flag.FLAT`.

    Args, returns: as of `label_masks`.
    """
    rejects: list[MaskReject] = []
    boxes, kept = [], []
    for i, (crop, origin) in enumerate(zip(masks.crops, masks.origins.tolist(), strict=True)):
        low = np.asarray(origin, dtype=np.float64)
        box = rectification.boxes([[*low, *(low + crop.shape[::-1])]])[0]
        foot = rectification.points_back([[(box[0] + box[2]) / 2, box[3]]])
        if (height := box[3] - box[1]) < limits.min_height_px:
            rejects.append((i, *_too_small(height, limits)))
        elif not _on_road(masks, np.array([i]), road, foot, limits.min_on_road)[0]:
            rejects.append((i, "off the road", ""))
        else:
            boxes.append(box)
            kept.append(i)
    if not kept:
        return Labels.empty(), rejects
    index = np.array(kept)
    flags = Flag.FLAT + Flag.TRUNCATED * _at_frame_border(masks, index) + Flag.TOUCHING * _touching(masks)[index]
    zeros = np.zeros(len(kept))
    return Labels(np.array(boxes), zeros, masks.class_ids[index], masks.scores[index], flags.astype(np.uint16)), rejects


def _too_small(height: float, limits: LabelLimits) -> tuple[str, str]:
    return "too small", f"{height:.1f} px high, at least {limits.min_height_px:g} wanted"


def _truncated(boxes: Array, size_wh: tuple[int, int]) -> NDArray[np.bool_]:
    low = (boxes[:, :2] < _BORDER_PX).any(axis=1)
    high = (boxes[:, 2:] > np.asarray(size_wh) - _BORDER_PX).any(axis=1)
    return np.asarray(low | high)


def _at_frame_border(masks: InstanceMasks, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    low = masks.origins[index]
    high = low + np.array([masks.crops[i].shape[::-1] for i in index.tolist()])
    return np.asarray((low <= 0).any(axis=1) | (high >= np.asarray(masks.frame_wh)).any(axis=1))


def _on_road(
    masks: InstanceMasks, index: NDArray[np.int64], road: NDArray[np.bool_], feet_px: Array, least: float
) -> NDArray[np.bool_]:
    """Whether the foot of the box, or enough of the mask, is on the road."""
    out = np.zeros(len(index), dtype=np.bool_)
    height, width = road.shape
    for j, i in enumerate(index.tolist()):
        (x, y), crop = masks.origins[i].tolist(), masks.crops[i]
        share = road[y : y + crop.shape[0], x : x + crop.shape[1]][crop].mean()
        fx, fy = feet_px[j] if np.isfinite(feet_px[j]).all() else (-1.0, -1.0)
        inside = 0 <= fx < width and 0 <= fy < height
        out[j] = share >= least or (inside and road[int(fy), int(fx)])
    return out


def _implausible(
    vertices: Array, rectification: Rectification, camera: Camera, limits: LabelLimits
) -> tuple[NDArray[np.bool_], Array]:
    if camera.scale is None:
        return np.zeros(len(vertices), dtype=np.bool_), np.full((len(vertices), 3), np.nan)
    sizes = cuboid_sizes(rectification.points_back(vertices), camera)
    with np.errstate(invalid="ignore"):
        bad = np.asarray(~((sizes >= limits.least_m) & (sizes <= limits.most_m)).all(axis=1))
    return bad, sizes


def _touching(masks: InstanceMasks) -> NDArray[np.bool_]:
    """(N,) which masks have another one next to them."""
    n = len(masks)
    out = np.zeros(n, dtype=np.bool_)
    low = masks.origins.reshape(-1, 2)
    high = low + np.array([crop.shape[::-1] for crop in masks.crops], dtype=np.int64).reshape(-1, 2)
    near = (low[:, None] <= high[None] + 1).all(-1) & (low[None] <= high[:, None] + 1).all(-1)
    for a, b in zip(*np.nonzero(np.triu(near, 1)), strict=True):
        x0, y0 = np.minimum(low[a], low[b]).tolist()
        x1, y1 = np.maximum(high[a], high[b]).tolist()
        grown, other = (_placed(masks, i, (x0 - 1, y0 - 1, x1 + 1, y1 + 1)) for i in (a, b))
        if np.logical_and(cv2.dilate(grown, np.ones((3, 3), np.uint8)), other).any():
            out[[a, b]] = True
    return out


def _placed(masks: InstanceMasks, i: int, window: Sequence[int]) -> NDArray[np.uint8]:
    canvas = np.zeros((window[3] - window[1], window[2] - window[0]), dtype=np.uint8)
    (x, y), crop = masks.origins[i].tolist(), masks.crops[i]
    canvas[y - window[1] : y - window[1] + crop.shape[0], x - window[0] : x - window[0] + crop.shape[1]] = crop
    return canvas
