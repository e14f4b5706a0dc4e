"""Labels from instance masks: silhouettes of cuboids give their label, others are rejected with a reason."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from clips import CAMERA, SIZE, road_mask, vehicle_boxes

from labelgen.geometry import Pair, Rectification, Region, RoadMask, encode_boxes, rectified_outline
from labelgen.labeling import FrameLabels, LabelLimits, flat_labels, label_masks
from labelgen.labels import Flag, IgnoreReason, VehicleClass
from labelgen.masks import InstanceMasks

FRAME = 20
"""A frame in which both vehicles are whole."""
ROAD = RoadMask(road_mask())
RECTIFICATION = Rectification.from_road_mask(CAMERA, ROAD, Pair.VP2_VP3, (640, 360))
FLAT = Rectification.of_region(Region.NONE, CAMERA, ROAD, Pair.VP2_VP3, (640, 360))


def _masks(polygons: list[np.ndarray]) -> InstanceMasks:
    """Instance masks of the convex hulls of points (K, 2), frame px."""
    origins, crops = [], []
    for polygon in polygons:
        canvas = np.zeros(SIZE[::-1], np.uint8)
        hull = cv2.convexHull(polygon.astype(np.float32))
        cv2.fillConvexPoly(canvas, np.round((hull - 0.5) * 256).astype(np.int32), 1, shift=8)
        x, y, w, h = cv2.boundingRect(canvas)
        origins.append((x, y))
        crops.append(canvas[y : y + h, x : x + w] > 0)
    n = len(polygons)
    return InstanceMasks(SIZE, np.array(origins), tuple(crops), np.full(n, VehicleClass.CAR), np.full(n, 0.9))


def test_silhouettes_of_cuboids_give_their_labels() -> None:
    boxes = vehicle_boxes(FRAME)
    labels, rejects, _ = label_masks(_masks(list(boxes)), RECTIFICATION, CAMERA, ROAD.pixels)
    exact = encode_boxes(RECTIFICATION.points(boxes), RECTIFICATION.vpu)
    assert rejects == []
    assert labels.class_ids.tolist() == [VehicleClass.CAR] * 2
    np.testing.assert_allclose(labels.boxes_xyxy, exact.boxes_xyxy, atol=2.5)
    np.testing.assert_allclose(labels.cc, exact.cc, atol=0.03)


@pytest.mark.parametrize("flat", [False, True])
def test_masks_that_do_not_move_give_no_label(flat: bool) -> None:
    masks = replace(_masks(list(vehicle_boxes(FRAME))), moving=np.array([False, True]))
    labels, rejects, ignored = (
        flat_labels(masks, FLAT, ROAD.pixels) if flat else label_masks(masks, RECTIFICATION, CAMERA, ROAD.pixels)
    )
    assert (len(labels), len(ignored)) == (1, 1)
    assert [reject[:2] for reject in rejects] == [(0, "does not move")]


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        (LabelLimits(min_height_px=300.0), "too small"),
        (LabelLimits(max_size_lwh_m=(3.0, 3.0, 3.0)), "implausible size"),
        (LabelLimits(min_size_lwh_m=(6.0, 0.5, 0.5)), "implausible size"),
    ],
)
def test_limits_reject_masks_with_a_reason(limits: LabelLimits, reason: str) -> None:
    labels, rejects, _ = label_masks(
        _masks(list(vehicle_boxes(FRAME))), RECTIFICATION, CAMERA, ROAD.pixels, limits=limits
    )
    assert len(labels) == 0
    assert [reject[:2] for reject in rejects] == [(0, reason), (1, reason)]


def test_masks_off_the_road_are_rejected() -> None:
    labels, rejects, _ = label_masks(
        _masks(list(vehicle_boxes(FRAME))), RECTIFICATION, CAMERA, np.zeros_like(ROAD.pixels)
    )
    assert len(labels) == 0
    assert {reason for _, reason, _ in rejects} == {"off the road"}


def test_touching_masks_are_flagged() -> None:
    first = vehicle_boxes(FRAME)[0]
    second = first + np.array([np.ptp(first[:, 0]) - 2.0, np.ptp(first[:, 1]) / 4])
    labels, _, _ = label_masks(_masks([first, second]), RECTIFICATION, CAMERA, ROAD.pixels)
    assert labels.has(Flag.TOUCHING).tolist() == [True, True]


def test_frames_that_are_not_rectified_get_flat_labels() -> None:
    resizing = Rectification.of_region(Region.NONE, CAMERA, ROAD, Pair.VP2_VP3, (320, 180))
    boxes = vehicle_boxes(FRAME)
    labels, rejects, _ = flat_labels(_masks(list(boxes)), resizing, ROAD.pixels)
    assert rejects == []
    assert labels.has(Flag.FLAT).all()
    assert not labels.cc.any()
    expected = np.concatenate([boxes.min(axis=1), boxes.max(axis=1)], axis=1) / 2
    np.testing.assert_allclose(labels.boxes_xyxy, expected, atol=1.0)


@pytest.mark.parametrize("is_flat", [False, True])
@pytest.mark.parametrize(("are_predicted", "kept"), [(True, 2), (False, 3)])
def test_a_predicted_mask_inside_a_better_one_is_a_second_mask(is_flat: bool, are_predicted: bool, kept: int) -> None:
    boxes = vehicle_boxes(FRAME)
    middle = boxes[0].mean(axis=0)
    masks = _masks([*boxes, middle + 0.8 * (boxes[0] - middle)])
    scored = replace(masks, scores=np.array([0.9, 0.9, 0.6], np.float32), are_predicted=are_predicted)
    rectification = FLAT if is_flat else RECTIFICATION
    labels, rejects, _ = (
        flat_labels(scored, rectification, ROAD.pixels)
        if is_flat
        else label_masks(scored, rectification, CAMERA, ROAD.pixels)
    )
    assert len(labels) == kept
    assert rejects == ([(2, "inside a better mask", "")] if are_predicted else [])
    assert labels.has(Flag.TOUCHING)[:2].tolist() == [not are_predicted, False]


@pytest.mark.parametrize(("are_predicted", "gap_px", "is_cut"), [(True, 6, True), (True, 8, False), (False, 6, False)])
def test_a_predicted_mask_that_ends_near_the_border_is_cut(are_predicted: bool, gap_px: int, is_cut: bool) -> None:
    crop = np.ones((60, 80), np.bool_)
    origin = (SIZE[0] - 80 - gap_px, 200)
    masks = InstanceMasks.from_crops(SIZE, [(origin, crop)], [VehicleClass.CAR], [0.9], are_predicted=are_predicted)
    labels, _, _ = flat_labels(masks, FLAT, np.ones_like(ROAD.pixels))
    assert labels.has(Flag.TRUNCATED).tolist() == [is_cut]


def _labelled(
    polygons: list[np.ndarray], is_flat: bool, road: np.ndarray = ROAD.pixels, **changes: object
) -> tuple[FrameLabels, np.ndarray]:
    """Label masks, and return the boxes of their pixels in the rectified picture."""
    masks = _masks(polygons)
    limits = LabelLimits(**changes)
    if is_flat:
        return flat_labels(masks, FLAT, road, limits), FLAT.boxes(masks.boxes_xyxy)
    placed = zip(masks.crops, masks.origins.tolist(), strict=True)
    outlines = [rectified_outline(RECTIFICATION, crop, origin) for crop, origin in placed]
    return label_masks(masks, RECTIFICATION, CAMERA, road, limits=limits), np.array([o.box_xyxy for o in outlines])


@pytest.mark.parametrize(
    ("is_flat", "limits", "reason", "is_part"),
    [
        (False, {"min_height_px": 300.0}, IgnoreReason.TOO_SMALL, True),
        (True, {"min_height_px": 300.0}, IgnoreReason.TOO_SMALL, True),
        (False, {"min_size_lwh_m": (6.0, 0.5, 0.5)}, IgnoreReason.IMPLAUSIBLE_SIZE, True),
        (False, {"max_size_lwh_m": (3.0, 3.0, 3.0)}, IgnoreReason.IMPLAUSIBLE_SIZE, False),
        (False, {"road": np.zeros_like(ROAD.pixels)}, IgnoreReason.OFF_ROAD, False),
        (True, {"road": np.zeros_like(ROAD.pixels)}, IgnoreReason.OFF_ROAD, False),
    ],
)
def test_rejected_masks_leave_a_box_to_ignore(is_flat: bool, limits: dict, reason: IgnoreReason, is_part: bool) -> None:
    """A mask that is too small may show a part of a vehicle: its box is widened."""
    (labels, rejects, ignored), boxes = _labelled(list(vehicle_boxes(FRAME)), is_flat, **limits)
    assert len(labels) == 0
    assert [item for item, _, _ in rejects] == [0, 1]
    assert {text for _, text, _ in rejects} == {reason.text}
    assert ignored.reasons.tolist() == [reason, reason]
    if is_part:
        size, border = boxes[:, 2:] - boxes[:, :2], np.array([640, 360])
        margin = np.maximum(size / 2, (limits.get("min_height_px", 10) - size) / 2)
        low, high = boxes[:, :2] - margin, boxes[:, 2:] + margin
        # What the border takes on one side is added on the other.
        boxes = np.concatenate([low - np.maximum(high - border, 0), high - np.minimum(low, 0)], axis=1)
        boxes = boxes.clip(0, [640, 360, 640, 360])
    np.testing.assert_allclose(ignored.boxes_xyxy, boxes, atol=1e-4)


@pytest.mark.parametrize("is_flat", [False, True])
def test_labelled_masks_leave_none(is_flat: bool) -> None:
    (labels, _, ignored), _ = _labelled(list(vehicle_boxes(FRAME)), is_flat)
    assert (len(labels), len(ignored)) == (2, 0)


def _patch(x0: float, y0: float, x1: float, y1: float) -> InstanceMasks:
    """The mask of what a box of the rectified picture shows."""
    return _masks([RECTIFICATION.points_back([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])])


def test_a_mask_outside_the_rectified_picture_leaves_none() -> None:
    result = label_masks(_patch(280, 370, 320, 400), RECTIFICATION, CAMERA, ROAD.pixels)
    assert [reason for _, reason, _ in result.rejects] == ["outside the rectified image"]
    assert len(result.ignored) == 0


def test_what_the_border_leaves_of_a_vehicle_is_ignored_as_cut() -> None:
    result = label_masks(_patch(280, 354, 320, 380), RECTIFICATION, CAMERA, ROAD.pixels)
    assert [reason for _, reason, _ in result.rejects] == ["too small"]
    assert result.ignored.reasons.tolist() == [IgnoreReason.CUT]
    np.testing.assert_allclose(result.ignored.boxes_xyxy, [[260, 348, 340, 360]], atol=3)
    # Never smaller than a label: half of an anchor must lie in it.
    speck = label_masks(_patch(300, 357, 304, 380), RECTIFICATION, CAMERA, ROAD.pixels)
    x0, y0, x1, y1 = speck.ignored.boxes_xyxy[0].tolist()
    assert (x1 - x0, y1 - y0) == pytest.approx((10, 10), abs=2)
    assert y1 == 360


def test_a_mask_without_a_3d_box_is_ignored() -> None:
    masks = _patch(200, 150, 260, 190)
    level = replace(RECTIFICATION, vpu=np.array([-50.0, 170.0]))
    result = label_masks(masks, level, CAMERA, ROAD.pixels)
    assert [reason for _, reason, _ in result.rejects] == ["no valid 3D box"]
    assert result.ignored.reasons.tolist() == [IgnoreReason.NO_3D_BOX]
    np.testing.assert_allclose(result.ignored.boxes_xyxy, [[200, 150, 260, 190]], atol=2)


@pytest.mark.parametrize("is_flat", [False, True])
@pytest.mark.parametrize(
    ("shares", "limits", "reasons"),
    [
        # Shares of a vehicle's size, the best mask first.
        ([1.0, 0.8], {}, []),
        ([1.0, 0.8], {"min_height_px": 300.0}, [IgnoreReason.TOO_SMALL]),
        # The third lies in the second, which lies in the first: only two thirds of it have the label.
        ([0.82, 0.91, 1.0], {}, [IgnoreReason.OTHER]),
    ],
    ids=["labelled", "rejected as well", "in a second mask"],
)
def test_second_masks_are_ignored_where_no_other_box_covers_them(
    is_flat: bool, shares: list[float], limits: dict, reasons: list[IgnoreReason]
) -> None:
    corners = vehicle_boxes(FRAME)[0]
    middle = corners.mean(axis=0)
    masks = replace(
        _masks([middle + share * (corners - middle) for share in shares]),
        scores=np.linspace(0.9, 0.6, len(shares), dtype=np.float32),
        are_predicted=True,
    )
    road, changed = ROAD.pixels, LabelLimits(**limits)
    result = (
        flat_labels(masks, FLAT, road, changed)
        if is_flat
        else label_masks(masks, RECTIFICATION, CAMERA, road, limits=changed)
    )
    assert result.rejects[-1][:2] == (len(shares) - 1, "inside a better mask")
    assert result.ignored.reasons.tolist() == reasons
