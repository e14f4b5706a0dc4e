"""Measurement views: the image in which boxes lie, and the contact points of boxes."""

from __future__ import annotations

import numpy as np
import pytest
from speed_scenes import Drive, exact_detections, make_camera, make_road, make_view

from detector.speed.detections import inside_larger_box
from detector.speed.mask_detections import MaskPlacer
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.errors import LabelgenError, RectificationError
from labelgen.geometry import Camera, Pair, RoadMask
from labelgen.masks import InstanceMasks


def test_names() -> None:
    assert Variant.parse(" MaskRCNN3D ") is Variant.MASKRCNN3D
    with pytest.raises(LabelgenError, match="variant 4d: unknown variant; use one of transform3d, transform2d"):
        Variant.parse("4d")


@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize("variant", [Variant.TRANSFORM3D, Variant.PREVIOUS3D, Variant.MASKRCNN3D])
def test_the_contact_point_is_the_middle_of_the_near_edge_on_the_road(variant: Variant, pair: Pair) -> None:
    view = make_view(variant, pair)
    for drive in (Drive(50, 30.0, 4.0), Drive(50, 38.0, -3.0), Drive(50, 22.0, 0.3)):
        found = exact_detections(view, [drive], 0, 0.0)
        np.testing.assert_allclose(
            view.camera.road_points(found.contact_points_px), [[drive.start_m, drive.y_m]], atol=1e-6
        )
        ends = view.camera.road_points(found.front_edges_px[0])
        np.testing.assert_allclose(np.sort(ends[:, 1]), [drive.y_m - 0.9, drive.y_m + 0.9], atol=1e-6)


@pytest.mark.parametrize("pair", list(Pair))
def test_2d_variants_are_right_along_the_road_and_wrong_across_it(pair: Pair) -> None:
    drive = Drive(50, 30.0, 4.0)
    found = exact_detections(make_view(Variant.TRANSFORM2D, pair), [drive], 0, 0.0)
    [[x, y]] = make_camera().road_points(found.contact_points_px)
    assert x == pytest.approx(30.0, abs=1e-6)
    assert 0.1 < abs(y - 4.0) < 2.0


def test_boxes_that_fit_no_vehicle_are_left_out() -> None:
    view = make_view(Variant.TRANSFORM3D)
    boxes = [[300, 100, 340, 140], [340, 100, 300, 140], [300, 100, np.nan, 140], [300, 100, 340, 140]]
    found, valid = view.place(7, 0.28, boxes, [0.5, 0.5, 0.5, 1.5], [0.9, 0.8, 0.7, 0.6], [1, 2, 3, 4])
    assert valid.tolist() == [True, False, False, False]
    assert (len(found), found.frame, found.time_s, found.scores.tolist(), found.class_ids.tolist()) == (
        1, 7, 0.28, [0.9], [1],
    )  # fmt: skip


def test_previous_rectifies_the_whole_frame() -> None:
    view = make_view(Variant.PREVIOUS3D)
    assert view.rectification is not None
    corners = view.rectification.points([[0, 0], [1920, 0], [1920, 1080], [0, 1080]])
    assert corners.min(axis=0) == pytest.approx([0, 0], abs=1e-6)
    assert corners.max(axis=0) == pytest.approx(view.size_wh, abs=1e-6)


def test_a_frame_that_cannot_be_rectified_as_a_whole() -> None:
    """VP1 inside the frame: the road can be rectified, the frame not."""
    camera = Camera([1000.0, 150.0], [-18000.0, 560.0], [960.5, 540.5], 0.02, image_wh=(1920, 1080))
    road = make_road(camera, 20.0, 60.0)
    assert MeasurementView.create(Variant.TRANSFORM3D, camera, road, Pair.VP1_VP2, (360, 640)).size_wh == (360, 640)
    with pytest.raises(RectificationError, match="VP1"):
        MeasurementView.create(Variant.PREVIOUS3D, camera, road, Pair.VP1_VP2, (360, 640))


def cuboid_masks(drives: list[Drive]) -> InstanceMasks:
    """Exact masks of cuboids in the full frame."""
    import cv2

    width, height = 1920, 1080
    masks = []
    for drive in drives:
        hull = cv2.convexHull(drive.vertices_px(make_camera(), 0.0).astype(np.float32))[:, 0]
        yy, xx = np.mgrid[:height, :width] + 0.5
        inside = np.ones((height, width), dtype=bool)
        for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
            inside &= (b[0] - a[0]) * (yy - a[1]) - (b[1] - a[1]) * (xx - a[0]) >= 0
        masks.append(inside)
    return InstanceMasks.from_masks((width, height), masks, [1] * len(masks), np.full(len(masks), 0.9))


@pytest.mark.slow
@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize(
    ("variant", "across_m"),
    [
        (Variant.TRANSFORM3D, 0.1),
        (Variant.MASKRCNN3D, 0.1),
        (Variant.DUBSKA, 0.1),
        (Variant.SOCHOR, 0.1),
        (Variant.PREVIOUS3D, 0.2),
        (Variant.TRANSFORM2D, 2.0),
        (Variant.PREVIOUS2D, 2.0),
        (Variant.ORIG2D, 2.0),
    ],
)
def test_masks_become_detections(variant: Variant, pair: Pair, across_m: float) -> None:
    view = make_view(variant, pair)
    drives = [Drive(50, 24.0, 3.0), Drive(50, 38.0, -2.5)]
    placer = MaskPlacer(view, make_road(view.camera), pair)
    found = placer.place(5, 0.2, cuboid_masks(drives))
    assert (found.frame, found.time_s, len(found), found.class_ids.tolist()) == (5, 0.2, 2, [1, 1])
    ground = view.camera.road_points(found.contact_points_px)
    apart = np.abs(ground - [[24.0, 3.0], [38.0, -2.5]])
    assert (apart < [0.6 if variant is Variant.ORIG2D else 0.15, across_m]).all()
    assert not +placer.rejects


@pytest.mark.parametrize("variant", [Variant.TRANSFORM3D, Variant.MASKRCNN3D, Variant.ORIG2D])
def test_masks_off_the_road_are_counted(variant: Variant) -> None:
    view = make_view(variant)
    empty = np.zeros((1080, 1920), dtype=np.uint8)
    empty[900:1000, 100:300] = 255
    placer = MaskPlacer(view, RoadMask(empty), Pair.VP2_VP3)
    assert len(placer.place(0, 0.0, cuboid_masks([Drive(50, 30.0, 0.0)]))) == 0
    assert sum(placer.rejects.values()) == 1


@pytest.mark.parametrize("variant", list(Variant))
def test_a_frame_without_masks(variant: Variant) -> None:
    view = make_view(variant)
    found = MaskPlacer(view, make_road(view.camera), Pair.VP2_VP3).place(0, 0.0, InstanceMasks.empty((1920, 1080)))
    assert len(found) == 0
    assert found.to_dict()["boxes"] == []


def test_parts_of_a_vehicle_are_inside_its_box() -> None:
    """A box on the floor of a larger one is a part of its vehicle; cars behind, in front and beside are not."""
    lorry = Drive(50, 24.0, 0.0, size_lwh=(9.0, 2.5, 3.5))
    part = Drive(50, 28.0, 0.2, size_lwh=(1.5, 1.2, 1.0))
    others = [Drive(50, 34.0, 0.0), Drive(50, 18.0, 0.0), Drive(50, 26.0, 3.4), Drive(50, 26.0, -3.4)]
    for variant, expected in ((Variant.TRANSFORM3D, True), (Variant.MASKRCNN3D, True), (Variant.ORIG2D, False)):
        found = exact_detections(make_view(variant), [lorry, part, *others], 0, 0.0)
        assert len(found) == 6
        assert inside_larger_box(found).tolist() == [False, expected, False, False, False, False]
