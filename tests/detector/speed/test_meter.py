"""Speeds of cuboids that drive at known speeds, with exact boxes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from speed_scenes import CAR, Drive, exact_detections, make_camera, make_view

from detector.speed.meter import MeasureRules, SpeedMeter
from detector.speed.track_speed import MeasuredVehicle, median_speed_and_error
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, Pair


def drive_past(
    view: MeasurementView, drives: list[Drive], times_s: list[float], *, fps: float | None = None, **options: object
) -> list[MeasuredVehicle]:
    meter = SpeedMeter(view.camera, fps=fps, **options)  # type: ignore[arg-type]
    out: list[MeasuredVehicle] = []
    for number, time_s in enumerate(times_s):
        out += meter.add(exact_detections(view, drives, number, time_s))[1]
    return sorted(out + meter.finish(), key=lambda vehicle: vehicle.track_id)


STEADY = [n / 50 for n in range(250)]


@pytest.mark.parametrize("fps", [None, 50.0])
def test_times_that_cannot_be_end_tracks_and_nothing_else(fps: float | None) -> None:
    times = [0.0, 1e-300, 2e-300, 3e-300, 1e30, 1e301]
    assert drive_past(make_view(Variant.TRANSFORM3D), [Drive(72.0, 40.0)], times, fps=fps) == []


@pytest.mark.slow
@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize("variant", [v for v in Variant if v not in (Variant.ORIG2D, Variant.FITTED3D)])
@pytest.mark.parametrize(("heading", "start_m"), [(-1, 68.0), (1, 15.0)])
def test_every_variant_measures_the_speed(variant: Variant, pair: Pair, heading: int, start_m: float) -> None:
    """The lower side of a rectified box lies on the road, so the 2D variants are exact along it as well."""
    drives = [Drive(72.0, start_m, 1.5, heading), Drive(50.5, start_m, -3.0, heading, (9.0, 2.4, 3.1))]
    vehicles = drive_past(make_view(variant, pair), drives, STEADY)
    assert [v.speed_kmh for v in vehicles] == pytest.approx([72.0, 50.5], abs=0.01)
    assert [v.direction for v in vehicles] == ["towards" if heading < 0 else "away"] * 2
    assert all(v.uncertainty_kmh < 0.01 for v in vehicles)
    if variant.is_3d:
        sizes = np.array([v.size_lwh_m for v in vehicles])
        np.testing.assert_allclose(sizes, [CAR, (9.0, 2.4, 3.1)], atol=1e-3)
    else:
        assert np.isnan([v.size_lwh_m for v in vehicles]).all()


def test_the_box_in_the_frame_is_off_by_what_its_lower_side_hides() -> None:
    """orig2d: the middle of the lower side is no point of the vehicle, but its motion on the road is known."""
    camera, drive = make_camera(), Drive(72.0, 60.0, -4.0)
    [vehicle] = drive_past(make_view(Variant.ORIG2D), [drive], STEADY)
    times = vehicle.times_s
    boxes = np.array([drive.vertices_px(camera, t) for t in times])
    low = np.stack([(boxes[..., 0].min(axis=1) + boxes[..., 0].max(axis=1)) / 2, boxes[..., 1].max(axis=1)], axis=1)
    np.testing.assert_allclose(vehicle.points_px, low, atol=1e-9)
    ground = camera.road_points(low)
    step = np.linalg.norm(ground[5:] - ground[:-5], axis=1) / (times[5:] - times[:-5]) * 3.6
    assert vehicle.speed_kmh == pytest.approx(np.median(step), abs=1e-9)
    assert abs(vehicle.speed_kmh - 72.0) > 0.2


def test_time_stamps_count_not_frame_numbers() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.01, 0.05, 200)).tolist()
    [vehicle] = drive_past(make_view(Variant.TRANSFORM3D), [Drive(80.0, 68.0)], times, fps=33.0)
    assert vehicle.speed_kmh == pytest.approx(80.0, abs=0.01)
    assert vehicle.times_s.tolist() == [times[n] for n in vehicle.frames]


def test_dropped_frames_do_not_change_the_speed() -> None:
    times = [t for n, t in enumerate(STEADY) if not 40 <= n < 46 and n % 7]
    [vehicle] = drive_past(make_view(Variant.TRANSFORM3D), [Drive(80.0, 68.0)], times, fps=50.0)
    assert vehicle.speed_kmh == pytest.approx(80.0, abs=0.01)


@pytest.mark.parametrize("fps", [50.0, None])
def test_a_long_gap_in_time_ends_tracks(fps: float | None) -> None:
    """After two seconds without frames, a vehicle at the same place may be another one."""
    crawl = Drive(1.0, 30.0)
    times = [*(n / 50 for n in range(40)), *(2.8 + n / 50 for n in range(40))]
    rules = MeasureRules(min_length_px=1.0, min_along_m=0.1)
    assert len(drive_past(make_view(Variant.TRANSFORM3D), [crawl], times, fps=fps, rules=rules)) == 2


def test_frames_of_one_and_the_same_time_count_once() -> None:
    times = sorted([*STEADY, *STEADY[50:80]])
    [vehicle] = drive_past(make_view(Variant.TRANSFORM3D), [Drive(80.0, 68.0)], times)
    assert vehicle.speed_kmh == pytest.approx(80.0, abs=0.01)
    assert (np.diff(vehicle.times_s) > 0).all()


def line(camera: Camera, y_m: float) -> np.ndarray:
    first, second = np.hstack([camera.project([[15.0, y_m], [60.0, y_m]]), np.ones((2, 1))])
    return np.cross(first, second)


@pytest.mark.parametrize(
    ("rules", "expected"), [(MeasureRules(), (30, 69)), (MeasureRules(jump_m=np.inf), (4, 69))], ids=["ours", "off"]
)
def test_a_track_that_jumps_to_the_next_vehicle_is_its_longest_part(
    rules: MeasureRules, expected: tuple[int, int]
) -> None:
    """A car follows another; for three frames one box holds both, then the follower is hidden."""
    view = make_view(Variant.TRANSFORM3D)
    meter = SpeedMeter(view.camera, rules=rules)
    follower, both, first = (Drive(72.0, x, 0.0, -1, (length, *CAR[1:])) for x, length in ((49, 5), (42, 12), (42, 5)))
    vehicles = []
    for number in range(110):
        drive = follower if number < 30 else both if number < 33 else first
        vehicles += meter.add(exact_detections(view, [drive], number, number / 50))[1]
    [vehicle] = vehicles + meter.finish()
    assert (vehicle.frames[0], vehicle.frames[-1]) == expected
    assert vehicle.speed_kmh == pytest.approx(72.0, abs=0.01)


def test_lanes_by_their_border_lines() -> None:
    view = make_view(Variant.TRANSFORM3D)
    lanes = np.array([line(view.camera, y) for y in (5.0, 1.5, -2.0)])
    drives = [Drive(70.0, 68.0, 3.2), Drive(70.0, 68.0, -0.2), Drive(70.0, 68.0, -4.2)]
    vehicles = drive_past(view, drives, STEADY, lane_lines=lanes)
    assert sorted((v.lane is None, v.lane) for v in vehicles if v.lane is not None) == [(False, 0), (False, 1)]
    assert sum(v.lane is None for v in vehicles) == 1


@pytest.mark.parametrize(
    ("rules", "reason"),
    [
        (MeasureRules(min_points=1000), "too few points"),
        (MeasureRules(min_length_px=2000.0), "too short"),
        (MeasureRules(border_px=600.0), "too few points"),
    ],
)
def test_tracks_that_are_no_vehicles(rules: MeasureRules, reason: str) -> None:
    view = make_view(Variant.TRANSFORM3D)
    meter = SpeedMeter(view.camera, rules=rules)
    for number, time_s in enumerate(STEADY):
        assert meter.add(exact_detections(view, [Drive(80.0, 68.0)], number, time_s))[1] == []
    assert meter.finish() == []
    assert meter.dropped == {reason: 1}


def jitter(number: int, size_m: float) -> float:
    return size_m * float(np.random.default_rng(number).normal())


@pytest.mark.parametrize(
    ("what", "place_m", "reason"),
    [
        ("parked", lambda n: (30.0, 0.0), "stands still"),
        ("a shaking camera", lambda n: (30.0 + 0.3 * np.sin(n), 0.1 * np.cos(n)), "stands still"),
        ("flickers about one place", lambda n: (30.0 + jitter(n, 0.7) + 0.005 * n, 0.0), "stands still"),
        ("slides off the road", lambda n: (30.0 + 0.01 * n, 0.02 * n), "does not move along the road"),
        ("stands in a queue, then leaves", lambda n: (30.0 - max(0, n - 200) * 0.1, 0.0), None),
        ("changes lanes", lambda n: (60.0 - 0.1 * n, 0.014 * n), None),
    ],
)
def test_tracks_that_stay_where_they_are_are_no_traffic(
    what: str, place_m: Callable[[int], tuple[float, float]], reason: str | None
) -> None:
    view = make_view(Variant.TRANSFORM3D)
    meter = SpeedMeter(view.camera, rules=MeasureRules(min_length_px=20.0))
    vehicles = []
    for number, time_s in enumerate(STEADY):
        drive = Drive(0.0, *place_m(number))
        vehicles += meter.add(exact_detections(view, [drive], number, time_s))[1]
    vehicles += meter.finish()
    assert (len(vehicles), dict(meter.dropped)) == ((1, {}) if reason is None else (0, {reason: 1})), what


def test_rules_scale_with_the_frame() -> None:
    rules = MeasureRules.for_frame((1280, 720))
    assert (rules.border_px, rules.min_length_px) == pytest.approx((20 / 3, 200 / 3))
    assert MeasureRules.for_frame((320, 240)).border_px == 6.0
    assert MeasureRules.for_frame((1920, 1080)) == MeasureRules()


def test_points_cut_off_do_not_count() -> None:
    """Points of a car that leaves the frame at the lower border count while its contact with the road is visible."""
    view = make_view(Variant.TRANSFORM3D)
    [vehicle] = drive_past(view, [Drive(80.0, 40.0)], STEADY)
    assert vehicle.points_px[:, 1].max() < 1080 - 10
    height = view.size_wh[1]
    cut, _ = view.place(0, 0.0, [[300.0, 200.0, 340.0, height - 0.5], [300.0, 200.0, 340.0, height - 20.0]], [0.5, 0.5])
    assert cut.contact_visible.tolist() == [False, True]


def test_speed_so_far_comes_with_the_sixth_point() -> None:
    view = make_view(Variant.TRANSFORM3D)
    meter = SpeedMeter(view.camera)
    speeds = []
    for number in range(8):
        meter.add(exact_detections(view, [Drive(80.0, 45.0)], number, number / 50))
        speeds.append(meter.speed_so_far(1))
    assert np.isnan(speeds[:5]).all()
    assert speeds[5:] == pytest.approx([80.0] * 3, abs=0.01)
    assert np.isnan(meter.speed_so_far(99))


@pytest.mark.parametrize(("wander", "least", "most"), [(True, 0.55, 0.85), (False, 0.9, 1.0)])
def test_uncertainty_covers_the_error(wander: bool, least: float, most: float) -> None:
    """About two thirds of the errors lie within it where points wander slowly; more where each errs on its own."""
    rng = np.random.default_rng(0)
    times = np.arange(200) / 25
    within = []
    for _ in range(300):
        noise = rng.normal(0, 0.05, 200)
        along = 20.0 * times + (np.cumsum(noise) if wander else noise)
        speed, error = median_speed_and_error(np.stack([along, np.zeros(200)], axis=1), times)
        within.append(abs(speed - 72.0) < error)
    assert least < np.mean(within) <= most


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_points_have_no_speed(count: int) -> None:
    assert np.isnan(median_speed_and_error(np.zeros((count, 2)), np.arange(float(count)))).all()


def without_scale() -> Camera:
    full = make_camera()
    return Camera(full.vp1, full.vp2, full.pp, None, image_wh=full.image_wh)


def without_size() -> Camera:
    full = make_camera()
    return Camera(full.vp1, full.vp2, full.pp, full.scale)


@pytest.mark.parametrize(("camera", "message"), [(without_scale, "no scale"), (without_size, "size is not known")])
def test_cameras_that_cannot_measure(camera: Callable[[], Camera], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        MeasurementView(Variant.ORIG2D, camera(), None)
