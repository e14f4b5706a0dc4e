"""Made-up roads and the traffic on them: geometry and distances."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from labelgen.geometry.camera import look_at_road
from labelgen.synth.scene.scene import procedural_scene, road_to_image
from labelgen.synth.scene.traffic import random_traffic


def test_the_road_homography_agrees_with_the_camera() -> None:
    camera = look_at_road(7.0, (25.0, 3.0), 1500.0, (1920, 1080), 1.0)
    assert camera.height_m == pytest.approx(7.0)
    points = np.array([[12.0, -3.0], [40.0, 5.0], [80.0, 0.0]])
    mapped = np.column_stack([points, np.ones(3)]) @ road_to_image(camera).T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], camera.project(points), atol=1e-6)
    np.testing.assert_allclose(camera.project([25.0, 3.0]), [960, 540], atol=1e-6)


def test_a_scene_can_be_seen_from_a_given_camera() -> None:
    camera = look_at_road(7.0, (22.0, 0.3), 620.0, (640, 360))
    scene = procedural_scene(np.random.default_rng(0), (640, 360), heading=1, seen_from=(camera, -0.5))
    assert scene.camera is camera
    measured = [lane.y0 for lane in scene.lanes if lane.index is not None]
    assert np.mean(measured) == pytest.approx(-0.5)


def test_another_seed_gives_another_scene() -> None:
    first, again, other = (procedural_scene(np.random.default_rng(seed), (640, 360)) for seed in (1, 1, 2))
    assert first.camera.to_dict() == again.camera.to_dict() != other.camera.to_dict()


def test_vehicles_of_a_lane_never_meet() -> None:
    scene = procedural_scene(np.random.default_rng(3), (1280, 720))
    trips = random_traffic(scene, 30.0, 5, per_minute=40)
    assert len(trips) > 20
    for time_s in np.arange(0.0, 30.0, 0.5):
        for lane in scene.lanes:
            low, high = scene.x_range
            spans = sorted((t.near_x(time_s), t.near_x(time_s) + t.size_lwh[0]) for t in trips if t.lane is lane)
            spans = [span for span in spans if span[1] > low and span[0] < high]
            assert all(a[1] < b[0] for a, b in pairwise(spans))
