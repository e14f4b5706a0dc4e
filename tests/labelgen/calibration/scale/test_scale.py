"""The three methods for the scale, on outlines of known scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from random_cameras import random_camera
from speed_scenes import make_camera

from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.scale.estimate import ScaleEstimate
from labelgen.calibration.scale.from_dimensions import MEAN_VEHICLE_M, scale_from_dimensions
from labelgen.calibration.scale.from_distances import KnownDistance, parse_distance, scale_from_distances
from labelgen.calibration.scale.from_models import scale_from_models
from labelgen.calibration.scale.methods import parse_scale_method
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, road_cuboids
from labelgen.geometry.vehicle_bodies import common_bodies


def hull(points: np.ndarray) -> np.ndarray:
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)


def inside(camera: Camera, points: np.ndarray) -> bool:
    assert camera.image_wh is not None
    return bool(((points > 5) & (points < np.array(camera.image_wh) - 5)).all())


def cuboid_blobs(camera: Camera, count: int, size: tuple[float, float, float]) -> list[VehicleSilhouette]:
    rng = np.random.default_rng(0)
    near = np.stack([rng.uniform(25, 60, count), rng.uniform(-6, 6, count)], axis=1)
    vertices = camera.project(road_cuboids(near, np.tile(size, (count, 1))))
    return [VehicleSilhouette(i, float(i), hull(v)) for i, v in enumerate(vertices) if inside(camera, v)]


def vehicle_blobs(
    camera: Camera, count: int, *, seed: int = 0, noise_px: float = 0.0, merged: float = 0.0
) -> list[VehicleSilhouette]:
    """Outlines of vehicles of the common types, each with a size of its own; a share of them two in one outline."""
    rng = np.random.default_rng(seed)
    bodies = common_bodies()
    shares = np.array([body.share for body in bodies])
    silhouettes: list[VehicleSilhouette] = []
    while len(silhouettes) < count:
        parts = []
        x, y = rng.uniform(18, 45), rng.uniform(-6, 6)
        for k in range(2 if rng.random() < merged else 1):
            points = bodies[int(rng.choice(len(bodies), p=shares))].points * rng.normal(1, [0.05, 0.02, 0.03])
            points = points * [-1, -1, 1] + [x + 7 * k, y, 0]
            parts.append(camera.project(points))
        points = np.concatenate(parts)
        if inside(camera, points):
            outline = hull(points + rng.normal(0, noise_px, points.shape) if noise_px else points)
            silhouettes.append(VehicleSilhouette(len(silhouettes), 0.5 * len(silhouettes), outline))
    return silhouettes


# -- dimensions -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1 / 3, 1.0])
def test_exact_boxes_give_the_exact_scale(factor: float) -> None:
    camera = make_camera(factor)
    estimate = scale_from_dimensions(replace(camera, scale=None), cuboid_blobs(camera, 40, MEAN_VEHICLE_M))
    assert estimate.scale == pytest.approx(camera.scale, rel=2e-3)
    assert estimate.spread < 2e-3
    assert {round(v / estimate.scale, 2) for v in estimate.details.values()} == {1.0}


def test_the_mean_vehicle_can_be_another_one_and_the_least_ratio_counts() -> None:
    camera = make_camera()
    silhouettes = cuboid_blobs(camera, 40, (4.4, 1.8, 1.5))
    estimate = scale_from_dimensions(camera, silhouettes, mean_m=(4.4 * 1.3, 1.8 * 0.9, 1.5))
    assert camera.scale is not None
    assert estimate.scale == pytest.approx(0.9 * camera.scale, rel=5e-3)
    assert estimate.details["by_length"] == pytest.approx(1.3 * camera.scale, rel=5e-3)


@pytest.mark.parametrize("mean", [(4.27, 1.74), (4.27, 0.0, 1.5), (math.nan, 1.7, 1.5)])
def test_a_malformed_mean_vehicle_is_an_error(mean: tuple[float, ...]) -> None:
    with pytest.raises(CalibrationError, match="mean_m: expected length, width and height"):
        scale_from_dimensions(make_camera(), cuboid_blobs(make_camera(), 20, MEAN_VEHICLE_M), mean_m=mean)


# -- models ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_models_find_the_scale_of_any_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    while True:
        camera = random_camera(rng, pitch_deg=(8, 25), roll_deg=3)
        camera = replace(camera, scale=camera.scale * 9 / camera.height_m)  # type: ignore[operator]
        ahead = camera.project([[15.0, -6.0], [15.0, 6.0], [50.0, 6.0], [50.0, -6.0]])
        if inside(camera, ahead[2:]) and ((ahead > 0) & (ahead < [1920, 1500])).mean() > 0.8:
            break
    estimate = scale_from_models(replace(camera, scale=None), vehicle_blobs(camera, 60, seed=seed))
    assert camera.scale is not None
    assert estimate.scale == pytest.approx(camera.scale, rel=0.02)
    assert estimate.count > 45
    assert estimate.spread < 0.02


def test_models_tolerate_noise_and_merged_vehicles() -> None:
    camera = make_camera()
    silhouettes = vehicle_blobs(camera, 80, noise_px=1.5, merged=0.35)
    first = scale_from_models(replace(camera, scale=None), silhouettes)
    assert first.scale == pytest.approx(camera.scale, rel=0.03)
    assert first.count < 80
    # Whatever scale the camera states, it does not count; and the same outlines give the same.
    again = scale_from_models(replace(camera, scale=7.0), silhouettes)
    assert again == first


def few(camera: Camera) -> list[VehicleSilhouette]:
    return vehicle_blobs(camera, 5)


def tiny(camera: Camera) -> list[VehicleSilhouette]:
    return [replace(b, polygon_px=b.polygon_px.mean(axis=0) + 0.05 * b.polygon_px) for b in vehicle_blobs(camera, 20)]


def shapeless(camera: Camera) -> list[VehicleSilhouette]:
    rng = np.random.default_rng(3)
    middles = rng.uniform([300, 500], [1600, 900], (30, 2))
    wide = [[[-k, -9], [k, -9], [k, 9], [-k, 9]] for k in rng.uniform(60, 400, 30)]
    return [VehicleSilhouette(i, float(i), m + np.array(w)) for i, (m, w) in enumerate(zip(middles, wide, strict=True))]


@pytest.mark.parametrize(
    ("silhouettes", "reason"),
    [
        (few, "5 silhouettes of vehicles are large and whole enough"),
        (tiny, "0 silhouettes of vehicles are large and whole enough"),
        (shapeless, "of 30 silhouettes look like vehicles along the road"),
    ],
)
def test_models_refuse_too_few_vehicles(silhouettes: Callable[[Camera], list[VehicleSilhouette]], reason: str) -> None:
    with pytest.raises(CalibrationError, match=reason) as refusal:
        scale_from_models(make_camera(), silhouettes(make_camera()))
    assert "\n" not in str(refusal.value)
    assert "distance:x1,y1,x2,y2,METRES" in str(refusal.value)


# -- known distances ------------------------------------------------------------------------------------------


def ends(camera: Camera, *points_m: tuple[float, float]) -> str:
    return ",".join(f"{v:.9f}" for v in camera.project(np.array(points_m)).ravel())


def test_known_distances_give_the_exact_scale() -> None:
    camera = make_camera()
    along = parse_distance(f"{ends(camera, (20.0, 1.0), (50.0, 2.0))},{math.hypot(30, 1)}")
    # The two points of a lane's width need not lie abreast.
    lane = parse_distance(f"{ends(camera, (20.0, 1.75), (45.0, -1.75))},3.5", across=True)
    for known in ([along], [lane], [along, lane]):
        estimate = scale_from_distances(replace(camera, scale=None), known)
        assert estimate.scale == pytest.approx(camera.scale, rel=1e-6)
        assert estimate.count == len(known)
        assert math.isnan(estimate.spread) == (len(known) == 1)


def test_longer_distances_weigh_more() -> None:
    camera = make_camera()
    wrong = parse_distance(f"{ends(camera, (20.0, 0.0), (21.0, 0.0))},1.5")
    right = parse_distance(f"{ends(camera, (20.0, 0.0), (50.0, 0.0))},30")
    estimate = scale_from_distances(camera, [wrong, right])
    assert estimate.scale == pytest.approx(camera.scale, rel=1e-3)
    assert estimate.details["worst_m"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1,2,3,4", "expected five numbers; write x1,y1,x2,y2,METRES"),
        ("1,2,3,4,5,6", "expected five numbers"),
        ("a,2,3,4,5", "expected five numbers"),
        ("1,2,3,4,-5", "expected two different points and metres > 0"),
        ("1,2,1,2,5", "expected two different points"),
        ("1,2,nan,4,5", "expected two different points"),
    ],
)
def test_malformed_distances_are_errors(text: str, reason: str) -> None:
    with pytest.raises(CalibrationError, match=reason):
        parse_distance(text)


def test_distances_that_cannot_be_measured() -> None:
    camera = make_camera()
    with pytest.raises(CalibrationError, match=r"lies on or above the horizon.*give two points on the road"):
        scale_from_distances(camera, [KnownDistance(((900.0, -4000.0), (900.0, 700.0)), 10.0)])
    lane = parse_distance(f"{ends(camera, (20.0, 1.0), (45.0, 1.0))},3.5", across=True)
    with pytest.raises(CalibrationError, match=r"both lie on one line along the road|gives none"):
        scale_from_distances(camera, [replace(lane, ends_px=(lane.ends_px[0], lane.ends_px[0]))])
    with pytest.raises(CalibrationError, match="no known distance given"):
        scale_from_distances(camera, [])


# -- by name --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("texts", "name"),
    [
        (["auto-models"], "auto-models"),
        (["auto-dimensions"], "auto-dimensions"),
        (["auto-dimensions:4.5,1.8,1.6"], "auto-dimensions"),
        (["distance:600,1000,640,700,5"], "distance"),
        (["distance:600,1000,640,700,5", "lane:600,1000,1400,1000,3.5"], "distance"),
    ],
)
def test_methods_by_name(texts: list[str], name: str) -> None:
    camera = make_camera()
    method = parse_scale_method(texts)
    estimate = method(replace(camera, scale=None), vehicle_blobs(camera, 40))
    assert (method.name, estimate.method) == (name, name)
    assert estimate.scale > 0


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        ([], "give one method, or known distances"),
        (["auto-models", "distance:1,2,3,4,5"], "give one method"),
        (["guess"], "scale guess: unknown method; use auto-models, auto-dimensions"),
        (["auto-models:x"], "unknown method"),
        (["auto-dimensions:4,2"], "expected the mean vehicle's LENGTH,WIDTH,HEIGHT in metres"),
        (["auto-dimensions:a,b,c"], "expected the mean vehicle's"),
        (["distance:1,2,3"], "expected five numbers"),
    ],
)
def test_unknown_methods_are_errors(texts: list[str], reason: str) -> None:
    with pytest.raises(CalibrationError, match=reason):
        parse_scale_method(texts)


def test_an_estimate_must_be_a_scale() -> None:
    with pytest.raises(CalibrationError, match="scale, distance: what was measured gives none"):
        ScaleEstimate(math.inf, 1, 0.0, "distance")
