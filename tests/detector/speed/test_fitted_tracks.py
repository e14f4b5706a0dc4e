"""Speeds of bodies laid over the outlines of tracks: forms of common vehicles, bad sightings, borders, braking."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from speed_scenes import CAR, Drive, exact_detections, make_camera, make_view

from detector.speed.contact_point import MaskExtent
from detector.speed.detections import Detections
from detector.speed.meter import SpeedMeter
from detector.speed.steady_path import smooth_path
from detector.speed.track_fit import TrackFitter
from detector.speed.track_speed import MeasuredVehicle
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.geometry import Pair, road_cuboids
from labelgen.geometry.homography import Array, bounding_boxes
from labelgen.geometry.vehicle_bodies import common_bodies

FPS = 12.5
BODY = next(body for body in common_bodies() if body.kind == "hatchback")
LENGTH = float(np.ptp(BODY.points[:, 0]))
VIEW = MeasurementView(Variant.FITTED3D, make_camera(), None, MaskExtent.BODY)

Change = Callable[[int, Array], Array]


def outline(middle_m: tuple[float, float]) -> Array:
    """The outline of the body that comes closer, its middle being there."""
    points = BODY.points * [-1, -1, 1] + [*middle_m, 0]
    hull = cv2.convexHull(VIEW.camera.project(points).astype(np.float32))
    return np.asarray(hull[:, 0], dtype=np.float64)


def sighting(number: int, polygon: Array) -> Detections:
    """What is detected of a vehicle that the picture's border may cut."""
    inside = polygon.clip([0, 0], VIEW.frame_wh)
    boxes = bounding_boxes(inside[None])
    near = VIEW.camera.road_points([[boxes[0, [0, 2]].mean(), boxes[0, 3]]])
    vertices = VIEW.camera.project(road_cuboids(near, np.array([CAR])))
    return VIEW.place(number, number / FPS, boxes, vertices_px=vertices, outlines_px=[inside])[0]


def measured(near_m: Array, change: Change | None = None) -> MeasuredVehicle:
    """Measure a body whose near end is at these distances in one frame after the other."""
    meter = SpeedMeter(VIEW.camera, fps=FPS, fitter=TrackFitter(VIEW))
    for number, x in enumerate(near_m.tolist()):
        polygon = outline((x + LENGTH / 2, -2.0))
        meter.add(sighting(number, polygon if change is None else change(number, polygon)))
    [vehicle] = meter.finish()
    return vehicle


def steady(speed_kmh: float, start_m: float = 60.0, end_m: float = 16.0) -> Array:
    step = speed_kmh / 3.6 / FPS
    return start_m - step * np.arange(int((start_m - end_m) / step) + 1)


def along(vehicle: MeasuredVehicle) -> Array:
    return np.asarray(VIEW.camera.road_points(vehicle.points_px)[:, 0])


def test_the_body_gives_speed_size_and_contact_point() -> None:
    near = steady(72.0)
    vehicle = measured(near)
    assert vehicle.speed_kmh == pytest.approx(72.0, abs=0.4)
    assert abs(vehicle.speed_kmh - 72.0) < 2 * vehicle.uncertainty_kmh < 3.0
    assert vehicle.direction == "towards"
    assert vehicle.size_lwh_m[[0, 2]] == pytest.approx([LENGTH, BODY.points[:, 2].max()], rel=0.06)
    assert np.abs(along(vehicle) - near[vehicle.frames]).max() < 0.35


def without_lower_half(number: int, polygon: Array) -> Array:
    if number not in (6, 13, 14):
        return polygon
    low, high = polygon[:, 1].min(), polygon[:, 1].max()
    return np.stack([polygon[:, 0], polygon[:, 1].clip(max=(low + high) / 2)], axis=1)


def test_single_bad_sightings_do_not_matter() -> None:
    near = steady(72.0)
    vehicle = measured(near, without_lower_half)
    assert vehicle.speed_kmh == pytest.approx(72.0, abs=0.6)
    assert np.abs(along(vehicle) - near[vehicle.frames]).max() < 0.6


def test_a_vehicle_that_leaves_the_picture_is_measured_inside_it() -> None:
    """The camera sees the road from 12 m on; sightings cut by the lower border are no points."""
    near = steady(60.0, 45.0, 4.0)
    vehicle = measured(near)
    assert vehicle.speed_kmh == pytest.approx(60.0, abs=0.6)
    assert vehicle.points_px[:, 1].max() < VIEW.frame_wh[1] - 5
    assert vehicle.frames[-1] < len(near) - 3


def test_braking_is_not_smoothed_away() -> None:
    """From 20 to 13 m/s within 2.5 s."""
    time = np.arange(0, 2.5, 1 / FPS)
    near = 60.0 - 20 * time + 1.4 * time**2
    vehicle = measured(near)
    true = near[vehicle.frames]
    assert vehicle.speed_kmh == pytest.approx(np.median(true[:-5] - true[5:]) / (5 / FPS) * 3.6, rel=0.025)
    assert np.abs(along(vehicle) - true).max() < 0.5
    speeds = -np.diff(along(vehicle)) * FPS
    assert speeds[0] > 18.0
    assert speeds[-1] < 14.5


def test_long_tracks_cost_no_more_than_the_places_they_get() -> None:
    near = np.full(500, 30.0) - 0.02 * np.arange(500)
    vehicle = measured(near)
    assert len(vehicle.frames) == 400
    assert vehicle.speed_kmh == pytest.approx(0.02 * FPS * 3.6, rel=0.05)


@pytest.mark.parametrize("pair", list(Pair))
def test_boxes_of_a_detector_are_cuboids(pair: Pair) -> None:
    """Rounded boxes and c_c with a little noise: one size for all of them steadies the points."""
    like = make_view(Variant.TRANSFORM3D, pair)
    view = MeasurementView(Variant.FITTED3D, like.camera, like.rectification)
    drives, rng = [Drive(72.0, 60.0, 1.5), Drive(50.5, 15.0, -3.0, 1, (9.0, 2.4, 3.1))], np.random.default_rng(4)
    found: dict[Variant, list[MeasuredVehicle]] = {like.variant: [], view.variant: []}
    meters = [SpeedMeter(like.camera, fps=25), SpeedMeter(like.camera, fps=25, fitter=TrackFitter(view))]
    for number in range(70):
        exact = exact_detections(like, drives, number, number / 25)
        boxes = exact.boxes_xyxy + rng.normal(0, 0.4, (len(exact), 4))
        cc = exact.cc + rng.normal(0, 0.01, len(exact))
        for one, meter in zip((like, view), meters, strict=True):
            found[one.variant] += meter.add(one.place(number, number / 25, boxes, cc)[0])[1]
    for one, meter in zip((like, view), meters, strict=True):
        found[one.variant] += meter.finish()
        # The vehicle that comes closer is seen last.
        found[one.variant].sort(key=lambda vehicle: vehicle.direction, reverse=True)
    single, fitted = found.values()
    errors = [[abs(v.speed_kmh - d.speed_kmh) for v, d in zip(vs, drives, strict=True)] for vs in (single, fitted)]
    assert max(errors[1]) < 0.6
    assert sum(errors[1]) < sum(errors[0])
    for vehicle, drive in zip(fitted, drives, strict=True):
        assert vehicle.size_lwh_m == pytest.approx(drive.size_lwh, rel=0.05)


def test_a_path_follows_the_places_but_for_single_ones() -> None:
    time = np.arange(40) / 10
    true = np.stack([50 - 8 * time + 0.5 * time**2, np.full(40, 1.0)], axis=1)
    places = true + np.random.default_rng(1).normal(0, 0.05, true.shape)
    places[[7, 22]] += 3.0
    path = smooth_path(places, time, np.full(places.shape, 0.05))
    off = np.abs(path - true).max(axis=1)
    assert off[5:-5].max() < 0.08 < 0.25 > off.max()
    assert np.array_equal(smooth_path(places[:2], time[:2], np.full((2, 2), 0.05)), places[:2])
