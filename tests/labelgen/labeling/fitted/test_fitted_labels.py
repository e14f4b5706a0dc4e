"""Labels of fitted bodies: drawn bodies of known size and place give the exact cuboid; what masks lack is completed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from labelgen.errors import CalibrationError, LabelgenError
from labelgen.geometry import Pair, Rectification, RoadMask, Rule, encode_boxes, label_outlines, road_cuboids
from labelgen.geometry.body_forms import MODES, form_directions, load_body_forms
from labelgen.geometry.boxes import iou_matrix
from labelgen.geometry.camera import look_at_road
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import common_bodies
from labelgen.labeling import FrameLabels, SeenFrame, label_masks, label_passages
from labelgen.labeling.fitted.settings import EXACT_MASKS, NETWORK_MASKS
from labelgen.labels import Flag, VehicleClass
from labelgen.masks import InstanceMasks

SIZE = (1280, 720)
CAMERA = look_at_road(9.0, (45.0, 2.0), 1400.0, SIZE)
ROAD = RoadMask(np.full(SIZE[::-1], 255, dtype=np.uint8))
STEP_S = 0.25
BODIES = {body.kind: body.points for body in common_bodies()}


def _rectification(pair: Pair, nearest_m: float = 28.0) -> Rectification:
    band, size = np.zeros(SIZE[::-1], dtype=np.uint8), (640, 360) if pair is Pair.VP2_VP3 else (360, 640)
    corners = [[nearest_m, 8.0], [nearest_m, -7.0], [95.0, -7.0], [95.0, 8.0]]
    cv2.fillConvexPoly(band, np.round(CAMERA.project(corners)).astype(np.int32), 255)
    return Rectification.from_road_mask(CAMERA, RoadMask(band), pair, size)


def _mask(points_px: Array, hide: Array | None = None) -> InstanceMasks:
    """The mask of the convex hull of points (K, 2), without the pixels right of x = `hide`."""
    canvas = np.zeros(SIZE[::-1], np.uint8)
    hull = cv2.convexHull(points_px.astype(np.float32))
    cv2.fillConvexPoly(canvas, np.round((hull - 0.5) * 256).astype(np.int32), 1, shift=8)
    if hide is not None:
        canvas[:, int(hide) :] = 0
    x, y, w, h = cv2.boundingRect(canvas)
    return InstanceMasks.from_crops(SIZE, [((x, y), canvas[y : y + h, x : x + w] > 0)], [0], [1.0])


def _size(kind: str) -> Array:
    points = BODIES[kind]
    width = 2 * np.abs(points[points[:, 2] < 0.5 * points[:, 2].max(), 1]).max()
    return np.array([np.ptp(points[:, 0]), width, points[:, 2].max()])


def _passage(kind: str, sign: int, count: int = 5) -> tuple[list[Array], list[Array]]:
    """Outlines, frame px, of a body that drives along the road, and the cuboids around it (8, 2) px."""
    size, outlines, cuboids = _size(kind), [], []
    ahead = 50.0 if sign > 0 else 75.0
    for k in range(count):
        near = np.array([ahead + sign * 5.0 * k, 3.0])
        points = BODIES[kind] * [sign, sign, 1]
        points[:, 0] += near[0] + size[0] / 2 - (points[:, 0].min() + points[:, 0].max()) / 2
        points[:, 1] += near[1]
        outlines.append(CAMERA.project(points))
        cuboids.append(CAMERA.project(road_cuboids(near[None], size[None]))[0])
    return outlines, cuboids


def _label(masks: list[InstanceMasks], pair: Pair = Pair.VP2_VP3) -> list[FrameLabels]:
    frames = [SeenFrame(k, STEP_S * k, m) for k, m in enumerate(masks)]
    return label_passages(frames, _rectification(pair), CAMERA, ROAD.pixels, EXACT_MASKS)


@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("kind", ["hatchback", "saloon", "suv", "van"])
def test_bodies_give_their_cuboids(kind: str, sign: int, pair: Pair) -> None:
    outlines, cuboids = _passage(kind, sign)
    rectification = _rectification(pair)
    masks = [_mask(outline) for outline in outlines]
    for given, mask, cuboid in zip(_label(masks, pair), masks, cuboids, strict=True):
        assert given.rejects == []
        exact = encode_boxes(rectification.points(cuboid)[None], rectification.vpu)
        assert iou_matrix(given.labels.boxes_xyxy, exact.boxes_xyxy)[0, 0] > 0.9
        assert abs(given.labels.cc[0] - exact.cc[0]) < 0.03
        published = label_masks(mask, rectification, CAMERA, ROAD.pixels, Rule.WIDER).labels
        if len(published):
            assert (
                iou_matrix(published.boxes_xyxy, exact.boxes_xyxy)[0, 0]
                < iou_matrix(given.labels.boxes_xyxy, exact.boxes_xyxy)[0, 0]
            )


def test_stated_deviations_hold_the_errors() -> None:
    rectification = _rectification(Pair.VP2_VP3)
    beyond, total = 0, 0
    for kind in ("supermini", "hatchback", "saloon", "estate", "suv", "minivan"):
        outlines, cuboids = _passage(kind, 1)
        for given, cuboid in zip(_label([_mask(outline) for outline in outlines]), cuboids, strict=True):
            exact = encode_boxes(rectification.points(cuboid)[None], rectification.vpu)
            error = np.append(given.labels.boxes_xyxy[0] - exact.boxes_xyxy[0], given.labels.cc[0] - exact.cc[0])
            assert np.isfinite(given.labels.sigmas).all()
            beyond += int((np.abs(error) > 3 * given.labels.sigmas[0]).sum())
            total += 5
    assert beyond / total < 0.05


def test_one_size_in_all_sightings() -> None:
    outlines, _ = _passage("estate", 1)
    rectification = _rectification(Pair.VP2_VP3)
    from labelgen.geometry.cuboid import cuboid_sizes

    sizes = [
        cuboid_sizes(rectification.points_back(g.labels.vertices(rectification.vpu)[0]), CAMERA)[0]
        for g in _label([_mask(outline) for outline in outlines])
    ]
    np.testing.assert_allclose(sizes, np.median(sizes, axis=0)[None].repeat(5, axis=0), rtol=2e-3)


def test_a_hidden_part_is_completed_and_told() -> None:
    outlines, cuboids = _passage("saloon", 1, count=6)
    masks = [_mask(outline) for outline in outlines]
    low, high = outlines[3][:, 0].min(), outlines[3][:, 0].max()
    masks[3] = _mask(outlines[3], high - 0.3 * (high - low))
    rectification = _rectification(Pair.VP2_VP3)
    given = _label(masks)
    exact = encode_boxes(rectification.points(cuboids[3])[None], rectification.vpu)
    labels = given[3].labels
    assert iou_matrix(labels.boxes_xyxy, exact.boxes_xyxy)[0, 0] > 0.8
    assert labels.has(Flag.OCCLUDED).all()
    assert 0.15 < labels.hidden[0] < 0.45
    assert not given[0].labels.has(Flag.OCCLUDED).any()
    assert given[0].labels.hidden[0] < 0.1


def test_the_cuboid_goes_on_beyond_the_border() -> None:
    # The last sighting is cut by the lower border of the frame.
    size, points = _size("saloon"), BODIES["saloon"]
    masks, nears = [], []
    for k in range(6):
        near = np.array([35.0 - 4.0 * k, 2.0])
        turned = points * [-1, -1, 1] + [near[0] + size[0] / 2, near[1], 0]
        outline = CAMERA.project(turned)
        nears.append(near)
        masks.append(_mask(outline))
    boxes = masks[-1].boxes_xyxy[0]
    assert boxes[3] == SIZE[1], "the vehicle must be cut"
    rectification = _rectification(Pair.VP2_VP3, nearest_m=14.0)
    frames = [SeenFrame(k, STEP_S * k, m) for k, m in enumerate(masks)]
    labels = label_passages(frames, rectification, CAMERA, ROAD.pixels, EXACT_MASKS)[-1].labels
    exact = encode_boxes(
        rectification.points(CAMERA.project(road_cuboids(nears[-1][None], size[None]))), rectification.vpu
    )
    assert labels.has(Flag.TRUNCATED).all()
    height = exact.boxes_xyxy[0, 3] - exact.boxes_xyxy[0, 1]
    assert abs(labels.boxes_xyxy[0, 3] - exact.boxes_xyxy[0, 3]) < 0.15 * height


@pytest.mark.parametrize("step_s", [0.25, 1.0])
def test_labels_stay_on_vehicles_that_brake(step_s: float) -> None:
    # From 15 m/s down to 3 m/s: the path of the whole passage is no straight line in time.
    rectification, size = _rectification(Pair.VP2_VP3), _size("saloon")
    points = BODIES["saloon"] - [(BODIES["saloon"][:, 0].min() + BODIES["saloon"][:, 0].max()) / 2, 0, 0]
    frames, exact = [], []
    for k in range(int(5 / step_s) + 1):
        time_s = step_s * k
        near = np.array([32.0 + 15.0 * time_s - 1.2 * time_s**2, 1.0])
        place = np.array([near[0] + size[0] / 2, near[1], 0])
        frames.append(SeenFrame(k, time_s, _mask(CAMERA.project(points + place))))
        cuboid = CAMERA.project(road_cuboids(near[None], size[None]))
        exact.append(encode_boxes(rectification.points(cuboid), rectification.vpu).boxes_xyxy)
    given = label_passages(frames, rectification, CAMERA, ROAD.pixels, NETWORK_MASKS)
    found = [iou_matrix(g.labels.boxes_xyxy, box)[0, 0] for g, box in zip(given, exact, strict=True) if len(g.labels)]
    assert len(found) >= len(frames) - 1
    assert min(found) > 0.85


def test_classes_follow_the_source_or_the_fit() -> None:
    outlines, _ = _passage("van", 1)
    masks = [_mask(outline) for outline in outlines]
    assert {int(c) for g in _label(masks) for c in g.labels.class_ids} == {VehicleClass.CAR}
    named = [replace(m, class_ids=np.array([VehicleClass.TRUCK], dtype=np.uint8)) for m in masks]
    assert {int(c) for g in _label(named) for c in g.labels.class_ids} == {VehicleClass.TRUCK}


def test_what_no_body_fits_is_rejected_and_ignored() -> None:
    # A mask as high as a house.
    tall = CAMERA.project([[60.0, 2.0, 0.0], [60.0, 3.0, 0.0], [60.5, 2.0, 9.0], [60.5, 3.0, 9.0]])
    given = _label([_mask(tall)])[0]
    assert len(given.labels) == 0
    assert len(given.ignored) == 1
    assert given.rejects[0][1] in ("no valid 3D box", "implausible size")


def test_a_camera_without_a_scale_is_refused_in_one_line() -> None:
    outlines, _ = _passage("suv", 1, count=1)
    camera = replace(CAMERA, scale=None)
    with pytest.raises(CalibrationError, match=r"no scale.*choose another rule") as error:
        label_passages([SeenFrame(0, 0.0, _mask(outlines[0]))], _rectification(Pair.VP2_VP3), camera, ROAD.pixels,
                       EXACT_MASKS)  # fmt: skip
    assert "\n" not in str(error.value)


def test_frames_without_masks_give_nothing() -> None:
    given = _label([InstanceMasks.empty(SIZE)] * 3)
    assert [len(g.labels) for g in given] == [0, 0, 0]


def test_the_rule_needs_passages() -> None:
    with pytest.raises(LabelgenError, match="whole passages"):
        label_outlines([], (0.0, -100.0), Rule.FITTED)


# -- forms --------------------------------------------------------------------------------------------------


def test_forms_are_unit_bodies() -> None:
    forms = load_body_forms()
    axes = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    for number, form in enumerate(forms.forms):
        reach, _, _ = forms.support(np.array([number]), axes[None], np.zeros((1, MODES)))
        np.testing.assert_allclose(reach[0], [0.5, 0.5, 0.5, 0.5, 1, 0], atol=0.02, err_msg=form.name)


def test_points_that_reach_farthest_are_the_derivatives() -> None:
    forms = load_body_forms()
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1, 200, 3)) * [1, 1, 0.6]
    weights = rng.normal(size=(1, MODES))
    reach, points, modes = forms.support(np.array([0]), directions, weights)
    np.testing.assert_allclose((directions * points).sum(axis=-1), reach, rtol=1e-6)
    step = 1e-5
    for axis in range(3):
        moved, _, _ = forms.support(np.array([0]), directions + step * np.eye(3)[axis], weights)
        close = np.abs((moved - reach) / step - points[..., axis]) < 1e-3
        assert close.mean() > 0.98  # but for directions at the border of two cells
    more, _, _ = forms.support(np.array([0]), directions, weights + np.eye(MODES)[2])
    np.testing.assert_allclose(more - reach, modes[..., 2], atol=1e-9)


def test_the_file_of_forms_is_up_to_date() -> None:
    from tools.studies.body_forms import FAMILIES, family_supports, unit_bodies

    forms = load_body_forms()
    assert [form.name for form in forms.forms] == list(FAMILIES)
    count = len(form_directions())
    for number, (name, family) in enumerate(FAMILIES.items()):
        mean, modes = np.split(forms.table[number * count : (number + 1) * count].T.astype(np.float64), [1])
        body = family_supports(unit_bodies(family, count=1)[:1])[0]
        # A body of the family is near its mean, along the modes.
        along = np.linalg.lstsq(modes.T, body - mean[0], rcond=None)[0]
        assert np.abs(body - mean[0] - along @ modes).max() < 0.06, name
        assert np.abs(along).max() < 6, name
