"""The camera from vehicles that keep their size, on drawn outlines."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from labelgen.calibration.observation.collect import Observations
from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.vanishing.bundle_adjustment import refine_orientation
from labelgen.calibration.vanishing.orientation import estimate_orientation
from labelgen.geometry import Camera
from labelgen.geometry.camera import look_at_road
from labelgen.geometry.vehicle_bodies import common_bodies

WH = (1920, 1080)


def angle_deg(camera: Camera, other: Camera) -> float:
    """Between the two VP1, at the first camera."""
    a, b = (np.array([*(c.vp1 - camera.pp), camera.focal]) for c in (camera, other))
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def traffic(
    camera: Camera, vehicles: int, *, slide: float, firm_sides: bool = False, seed: int = 0
) -> tuple[Observations, list[VehicleSilhouette]]:
    """Vehicles that come along the road, with exact outlines three times per second.

    Features slide down the bodies by this much per metre driven, m: what reflections and rounded edges do; those at
    the sides do not where these are firm.
    """
    rng = np.random.default_rng(seed)
    bodies = common_bodies()
    tracks, edgelets, silhouettes = [], [], []
    for number in range(vehicles):
        body = bodies[int(rng.choice(len(bodies), p=[b.share for b in bodies]))].points
        body = body * rng.normal(1, [0.04, 0.02, 0.03])
        start, y, times = 4.0 * number, rng.choice([-4.5, -1.0, 2.5]), np.arange(0, 3.6, 0.1)
        x = 75 - 16.0 * times
        for _ in range(8):
            dx, dy, z = rng.uniform([-1.8, -0.7, 0.6], [1.8, 0.7, 1.3])
            firm = firm_sides and abs(dy) > 0.45
            sunk = z - (0.0 if firm else slide) * (x[0] - x)
            px = camera.project(np.stack([x + dx, np.full_like(x, y + dy), sunk], axis=1))
            inside = ((px > 5) & (px < np.array(WH) - 5)).all(axis=1)
            if inside.sum() > 8:
                tracks.append(Track(start + times[inside], px[inside] + rng.normal(0, 0.3, (inside.sum(), 2))))
        for time_s, at in zip(times[::3], x[::3], strict=True):
            px = camera.project(body * [-1, -1, 1] + [at, y, 0])
            if not ((px > 5) & (px < np.array(WH) - 5)).all():
                continue
            outline = cv2.convexHull((px + rng.normal(0, 0.5, px.shape)).astype(np.float32))[:, 0].astype(np.float64)
            silhouettes.append(VehicleSilhouette(round(10 * (start + time_s)), start + time_s, outline))
            for z in (0.3, 0.5, 0.9):
                ends = camera.project([[at - 2, y - 0.7, z], [at - 2, y + 0.7, z]])
                edgelets.append([*(ends + rng.normal(0, 0.3, (2, 2))).ravel(), start + time_s])
            ends = camera.project([[at - 2, y - 0.8, 0.3], [at - 2, y - 0.8, 1.2]])
            edgelets.append([*ends.ravel(), start + time_s])
    duration = 4.0 * vehicles
    return Observations(
        WH, 10.0, duration, tracks, np.array(edgelets), np.zeros(10), 0.0, None, True
    ), sorted(silhouettes, key=lambda silhouette: silhouette.time_s)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "focal"), [((35.0, 5.0), 2000), ((30.0, -14.0), 1800)], ids=["nearly straight ahead", "oblique"]
)
def test_bundle_adjustment_reduces_the_error_of_sliding_features(target, focal):
    camera = replace(look_at_road(9.0, target, focal, WH, 0.5), pp=np.array([960.0, 540.0]))
    observations, silhouettes = traffic(camera, 30, slide=0.009)
    first = estimate_orientation("drawn", observations, None)
    refined = refine_orientation(observations, first, silhouettes)
    before, after = angle_deg(camera, first.camera), angle_deg(camera, refined.camera)
    assert before > 0.3
    # Here everything slides, also what is at the vehicles' sides, of which tracks are believed to 10 px.
    assert after < 0.65 * before
    assert refined.evidence.reobserved_vehicles > 20
    # The spread says what silhouettes and tracks together are good for, not how well the tracks agree.
    assert 0.5 * after < 2 * refined.evidence.vp1_sd_deg < 3
    assert refined.camera.focal == pytest.approx(focal, rel=0.06)
    assert refined.supporting is first.supporting


def test_sliding_features_in_the_middle_of_vehicles_do_not_move_vp1():
    camera = replace(look_at_road(9.0, (35.0, 5.0), 2000, WH, 0.5), pp=np.array([960.0, 540.0]))
    all_slide, firm = (
        angle_deg(camera, estimate_orientation("drawn", traffic(camera, 30, slide=0.009, firm_sides=f)[0], None).camera)
        for f in (False, True)
    )
    assert all_slide > 0.3
    assert firm < 0.5 * all_slide


def test_without_reobserved_vehicles_the_camera_stays():
    camera = look_at_road(9.0, (35.0, 5.0), 2000, WH, 0.5)
    observations, silhouettes = traffic(camera, 12, slide=0.0)
    first = estimate_orientation("drawn", observations, None)
    once = {silhouette.time_s // 4: silhouette for silhouette in silhouettes}
    assert refine_orientation(observations, first, []) is first
    assert refine_orientation(observations, first, list(once.values())) is first
    assert refine_orientation(observations, first, [replace(s, joined=True) for s in silhouettes]) is first
