"""Labels from masks: analytic cases, and what must hold for any mask."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from labelgen.errors import LabelgenError
from labelgen.geometry import RectifiedOutline, Rule, decode_boxes, label_outlines, mask_outline, rectified_outline
from tools.studies.cuboid_labels import rasterise

TANGENT_RULES = [rule for rule in Rule if rule.is_of_tangents]


@pytest.mark.parametrize("rule", TANGENT_RULES)
def test_cc_stays_in_its_range(rule):
    # Weighting two candidates that both lie on the box's edge must not leave it by a rounding error:
    # `Labels` would refuse the whole image.
    rng = np.random.default_rng(0)
    low = np.floor(rng.uniform(0, 300, (5000, 2)))
    high = low + rng.integers(2, 60, (5000, 2))
    outlines = [
        RectifiedOutline(
            np.array([*a, *b]), np.array([a + 0.5, [b[0] - 0.5, a[1] + 0.5], b - 0.5, [a[0] + 0.5, b[1] - 0.5]])
        )
        for a, b in zip(low, high, strict=True)
    ]
    for vpu in ((-200.3, 700.1), (150.7, 612.9), (640.1, -80.5), (120.2, -55.5)):
        labels = label_outlines(outlines, vpu, rule)
        assert labels.valid.all()
        assert labels.cc.min() >= 0
        assert labels.cc.max() <= 1


def test_rule_by_its_name_is_that_rule():
    outlines = [mask_outline(np.tri(50, dtype=bool))]
    by_name = {str(rule): label_outlines(outlines, (10, -50), rule.value).cc[0] for rule in TANGENT_RULES}
    by_rule = {str(rule): label_outlines(outlines, (10, -50), rule).cc[0] for rule in TANGENT_RULES}
    assert by_name == by_rule
    assert by_rule["wider"] != by_rule["conditioned"]
    with pytest.raises(ValueError, match="narrower"):
        label_outlines(outlines, (10, -50), "narrower")


@pytest.mark.parametrize(
    "mask",
    [
        np.full((4, 5), True),
        np.full((4, 5), 255, np.uint8),
        np.full((4, 5), 256, np.uint16),
        np.full((4, 5), 0.6),
        np.full((4, 5), -1, np.int32),
        np.full((10, 8), True)[::-2, :5][:4],
        np.full((5, 4), True).T,
    ],
    ids=lambda m: str(m.dtype),
)
def test_any_nonzero_value_is_set(mask, rectification):
    outline = mask_outline(mask, (10, 20))
    np.testing.assert_array_equal(outline.box_xyxy, [10, 20, 15, 24])
    small = rectified_outline(rectification, mask, (300, 200))
    full = rectified_outline(rectification, np.full((4, 5), True), (300, 200))
    np.testing.assert_array_equal(small.box_xyxy, full.box_xyxy)


# -- analytic cases ------------------------------------------------------------------------------------

VPUS = {
    "above, left": (-90.0, -120.0),
    "above, within": (310.0, -60.0),
    "above, right": (800.0, -150.0),
    "below, left": (-90.0, 560.0),
    "below, within": (310.0, 520.0),
    "below, right": (800.0, 640.0),
}


def _drawn(box, cc, vpu) -> tuple[np.ndarray, np.ndarray]:
    """The mask of one 3D box given by its label, in a picture of 640x360, and its 8 vertices."""
    vertices, valid = decode_boxes([box], [cc], vpu)
    assert valid.all()
    part, (x, y) = rasterise(vertices[0])
    mask = np.zeros((360, 640), bool)
    mask[y : y + part.shape[0], x : x + part.shape[1]] = part
    return mask, vertices[0]


@pytest.mark.parametrize("rule", TANGENT_RULES)
@pytest.mark.parametrize("vpu", VPUS.values(), ids=VPUS)
@pytest.mark.parametrize("cc", [0.12, 0.3, 0.5])
def test_solid_boxes_give_their_own_label(rule, vpu, cc):
    # Seen from above the top front edge lies high in its box, seen from below low.
    share = cc if vpu[1] < 0 else 1 - cc
    mask, _ = _drawn([180, 100, 460, 280], share, vpu)
    labels = label_outlines([mask_outline(mask)], vpu, rule)
    assert labels.valid.all()
    np.testing.assert_array_equal(labels.boxes_xyxy[0], [180, 100, 460, 280])
    # Both tangents tell the same, but for half a pixel in 180 times what the geometry makes of it.
    assert labels.cc[0] == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("vpu", VPUS.values(), ids=VPUS)
@pytest.mark.parametrize("rule", TANGENT_RULES)
def test_a_rectangle_has_no_depth(rule, vpu):
    mask = np.zeros((360, 640), bool)
    mask[60:300, 200:440] = True
    labels = label_outlines([mask_outline(mask)], vpu, rule)
    np.testing.assert_array_equal(labels.boxes_xyxy[0], [200, 60, 440, 300])
    # VPU above: the front face is all of it. VPU below: the roof is.
    assert labels.cc[0] == pytest.approx(0.0 if vpu[1] < 0 else 1.0, abs=0.02)


@pytest.mark.parametrize("vpu", VPUS.values(), ids=VPUS)
def test_the_published_rule_takes_the_wider_box(vpu):
    rng = np.random.default_rng(0)
    outlines = [mask_outline(_blob(rng)) for _ in range(50)]
    labels = label_outlines(outlines, vpu, Rule.WIDER)
    nearest_vpu = np.min if vpu[1] < 0 else np.max
    np.testing.assert_allclose(labels.cc, nearest_vpu(labels.candidates, axis=1), atol=1e-12)
    between = label_outlines(outlines, vpu, Rule.CONDITIONED)
    np.testing.assert_array_equal(between.candidates, labels.candidates)
    assert (between.cc >= labels.candidates.min(axis=1) - 1e-12).all()
    assert (between.cc <= labels.candidates.max(axis=1) + 1e-12).all()
    assert ((labels.candidates >= 0) & (labels.candidates <= 1)).all()


def _blob(rng: np.random.Generator) -> np.ndarray:
    """A random vehicle-like mask: the convex hull of a few points."""
    mask = np.zeros((360, 640), np.uint8)
    points = rng.uniform([220, 80], [420, 300], (8, 2)).astype(np.int32)
    return cv2.fillConvexPoly(mask, cv2.convexHull(points), 1)


def test_all_parts_count():
    vpu = VPUS["above, left"]
    whole, _ = _drawn([180, 100, 460, 280], 0.3, vpu)
    parts = whole.copy()
    parts[150:160] = False  # a pole in front of the vehicle
    parts[:, 300:310] = False
    assert cv2.connectedComponents(parts.astype(np.uint8))[0] - 1 == 4
    one, four = (label_outlines([mask_outline(m)], vpu) for m in (whole, parts))
    np.testing.assert_array_equal(one.boxes_xyxy, four.boxes_xyxy)
    np.testing.assert_allclose(one.cc, four.cc)
    single = np.zeros((10, 10), bool)
    single[4, 7] = True
    np.testing.assert_array_equal(mask_outline(single).box_xyxy, [7, 4, 8, 5])
    np.testing.assert_array_equal(mask_outline(single).hull, [[7.5, 4.5]])


@pytest.mark.parametrize("vpu", VPUS.values(), ids=VPUS)
@pytest.mark.parametrize("grow", [-2, 2])
def test_tight_and_loose_masks_move_the_label_little(vpu, grow):
    share = 0.3 if vpu[1] < 0 else 0.7
    mask, _ = _drawn([180, 100, 460, 280], share, vpu)
    kernel = np.ones((2 * abs(grow) + 1,) * 2, np.uint8)
    changed = (cv2.dilate if grow > 0 else cv2.erode)(mask.astype(np.uint8), kernel)
    labels = label_outlines([mask_outline(changed)], vpu)
    box = labels.boxes_xyxy[0]
    if grow > 0:
        np.testing.assert_array_equal(box, [178, 98, 462, 282])
    else:
        assert (box[:2] >= [182, 102]).all()
        assert (box[2:] <= [458, 278]).all()
    assert labels.cc[0] == pytest.approx(share, abs=0.1)


def test_masks_at_the_images_border_are_labelled():
    vpu = VPUS["above, left"]
    mask, _ = _drawn([0, 100, 280, 280], 0.3, vpu)
    labels = label_outlines([mask_outline(mask)], vpu)
    np.testing.assert_array_equal(labels.boxes_xyxy[0], [0, 100, 280, 280])
    full = label_outlines([mask_outline(np.ones((360, 640), bool))], vpu)
    np.testing.assert_array_equal(full.boxes_xyxy[0], [0, 0, 640, 360])
    assert full.valid.all()


@pytest.mark.parametrize(
    "vpu", [(300.0, 100.0), (300.0, 180.0), (0.0, 180.0), (300.0, 280.0), (np.nan, -50.0), (300.0, -np.inf)]
)
def test_without_tangents_there_is_no_label(vpu):
    mask = np.zeros((360, 640), bool)
    mask[100:280, 180:460] = True
    for rule in TANGENT_RULES:
        labels = label_outlines([mask_outline(mask)], vpu, rule)
        assert labels.valid.tolist() == [False]
        assert np.isnan(labels.cc).all()
        assert np.isnan(labels.candidates).all()
        np.testing.assert_array_equal(labels.boxes_xyxy[0], [180, 100, 460, 280])


def test_a_mask_without_a_label_does_not_change_other_labels():
    vpu = (300.0, 90.0)
    high, low = np.zeros((360, 640), bool), np.zeros((360, 640), bool)
    high[80:120, 180:460], low[200:300, 200:400] = True, True
    both = label_outlines([mask_outline(high), mask_outline(low)], vpu)
    assert both.valid.tolist() == [False, True]
    assert both.cc[1] == label_outlines([mask_outline(low)], vpu).cc[0]


def test_no_masks_and_empty_masks(rectification):
    labels = label_outlines([], (0, -50))
    assert labels.boxes_xyxy.shape == (0, 4)
    assert labels.cc.shape == labels.valid.shape == (0,)
    assert labels.candidates.shape == (0, 2)
    for empty in (np.zeros((5, 7), bool), np.zeros((0, 7), bool), np.zeros((5, 0), np.uint8)):
        assert mask_outline(empty) is None
        assert rectified_outline(rectification, empty) is None


# -- from the frame --------------------------------------------------------------------------------------


def _frame_mask() -> np.ndarray:
    return cv2.ellipse(np.zeros((360, 640), np.uint8), (310, 190), (60, 35), 0, 0, 360, 1, -1) > 0


def test_a_part_of_the_frame_gives_the_outline_of_the_whole(rectification):
    mask = _frame_mask()
    whole = rectified_outline(rectification, mask)
    part = rectified_outline(rectification, mask[140:240, 230:400], (230, 140))
    np.testing.assert_allclose(part.box_xyxy, whole.box_xyxy)
    np.testing.assert_allclose(part.hull, whole.hull)


def test_the_hull_agrees_with_the_rectified_pixels(rectification):
    mask = _frame_mask()
    plain = mask_outline(rectification.warp_mask(mask))
    fine = rectified_outline(rectification, mask)
    np.testing.assert_allclose(fine.box_xyxy, plain.box_xyxy, atol=1.0)
    rows, columns = np.nonzero(mask)
    middle = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    points = rectification.points(np.stack([columns, rows], axis=1)[:, None] + middle)
    np.testing.assert_allclose(fine.box_xyxy, [*points.min(axis=(0, 1)), *points.max(axis=(0, 1))], atol=1e-9)


def test_what_lies_outside_the_picture_is_cut(rectification):
    road_wide = np.ones((360, 640), bool)
    outline = rectified_outline(rectification, road_wide)
    assert (outline.box_xyxy >= 0).all()
    assert (outline.box_xyxy <= [*rectification.size_wh] * 2).all()
    area = cv2.contourArea(cv2.convexHull(outline.hull.astype(np.float32)))
    assert area == pytest.approx(rectification.frame_coverage * np.prod(rectification.size_wh), rel=0.02)
    sky = np.zeros((360, 640), bool)
    sky[:3, :40] = True
    assert rectified_outline(rectification, sky) is None


def test_rules_are_read_by_name():
    assert Rule.parse(" Wider ") is Rule.WIDER
    with pytest.raises(LabelgenError, match=r"narrower.*use one of wider, conditioned"):
        Rule.parse("narrower")
