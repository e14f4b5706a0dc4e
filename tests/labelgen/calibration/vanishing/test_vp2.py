"""Tilt and focal length from edges."""

import numpy as np
import pytest

from labelgen.calibration.vanishing.vp2 import estimate_vp2, normalize_edgelets, orthogonal_vanishing_points
from labelgen.geometry.camera import look_at_road

WH = (1920, 1080)
PP = np.array([960.0, 540.0])
UNIT = 1.2 * WH[0]


def scene(target, focal, roll, rng, *, count=3000, noise_deg=0.4, stray=0.5):
    """NormalizedEdges of vehicles in a known camera: across, up, along, and stray ones."""
    cam = look_at_road(9.0, target, focal, WH, roll)
    middles = rng.uniform([100, 250], [1800, 1050], (count, 2))
    road = cam.road_points(middles, invalid="nan")
    middles = middles[np.isfinite(road).all(axis=1) & (np.abs(road) < 120).all(axis=1)]
    kind = rng.choice(4, len(middles), p=[(1 - stray) * 0.6, (1 - stray) * 0.15, (1 - stray) * 0.25, stray])
    to = np.stack([cam.vp2, cam.vp3, cam.vp1])[np.minimum(kind, 2)] - middles
    angle = np.arctan2(to[:, 1], to[:, 0]) + np.radians(rng.normal(0, noise_deg, len(middles)))
    angle = np.where(kind == 3, rng.uniform(0, np.pi, len(middles)), angle)
    half = 15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return cam, np.concatenate([middles - half, middles + half], axis=1), middles


def estimate(cam, edgelets, middles):
    vp1 = np.array([*(cam.vp1 - PP) / UNIT, 1.0])
    return estimate_vp2(
        normalize_edgelets(edgelets, PP, UNIT), vp1, WH[0] / UNIT, road=(middles - PP) / UNIT, likelihood_power=0.3
    )


@pytest.mark.parametrize(
    ("target", "focal", "roll"),
    [((30.0, 10.0), 1800, 1.0), ((30.0, 10.0), 3500, -3.0), ((20.0, 15.0), 1000, 4.0), ((35.0, -3.0), 2500, -1.0)],
    ids=["oblique", "long lens", "wide, rolled", "nearly straight ahead"],
)
def test_tilt_and_focal_length_come_back(target, focal, roll):
    cam, edgelets, middles = scene(target, focal, roll, np.random.default_rng(1))
    vp2 = estimate(cam, edgelets, middles)
    horizon = cam.vp2 - cam.vp1
    assert np.degrees(vp2.tilt) == pytest.approx(np.degrees(np.arctan(horizon[1] / horizon[0])), abs=0.25)
    assert vp2.focal * UNIT == pytest.approx(focal, rel=0.04)
    assert abs(np.log(vp2.focal * UNIT / focal)) < 4 * vp2.focal_sd


def test_vp2_at_infinity_leaves_the_focal_length_to_the_prior_and_says_so():
    # Straight ahead, without upright edges: nothing in the picture depends on the focal length.
    rng = np.random.default_rng(2)
    cam = look_at_road(9.0, (40.0, 0.001), 2000, WH)
    middles = rng.uniform([100, 300], [1800, 1000], (500, 2))
    half = np.array([15.0, 0.0])
    edgelets = np.concatenate([middles - half, middles + half], axis=1)
    vp2 = estimate(cam, edgelets, middles)
    assert abs(vp2.tilt) < np.radians(0.2)
    assert vp2.focal_sd > 0.1


def test_directions_are_orthogonal_and_on_the_horizon():
    rng = np.random.default_rng(3)
    for _ in range(20):
        vp1 = np.array([*rng.normal(0, 0.5, 2), 1.0])
        tilt, focal = rng.uniform(-0.2, 0.2), rng.uniform(0.4, 3)
        across, up = orthogonal_vanishing_points(vp1, np.array(tilt), np.array(focal))
        rays = [p * [1, 1, focal] for p in (vp1, across, up)]
        for a, b in ((0, 1), (0, 2), (1, 2)):
            assert abs(rays[a] @ rays[b]) < 1e-9 * np.linalg.norm(rays[a]) * np.linalg.norm(rays[b])
        horizon = np.cross(vp1, across)
        assert np.arctan(-horizon[0] / horizon[1]) == pytest.approx(tilt)


def test_the_road_stays_below_the_horizon():
    cam, edgelets, middles = scene((30.0, 10.0), 1800, 0.0, np.random.default_rng(4), count=400, stray=0.95)
    vp2 = estimate(cam, edgelets, middles)
    down = np.array([-np.sin(vp2.tilt), np.cos(vp2.tilt)])
    assert ((middles - cam.vp1) @ down > 0).mean() > 0.95
