"""Boxes tangent to outlines: a cuboid's silhouette gives the cuboid back, whichever side of it is seen."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_cameras import random_camera

from labelgen.geometry import Camera, Pair, Rule, cuboid_sizes, road_cuboids, tangent_boxes

SIZES = np.array([[4.3, 1.75, 1.5], [11.8, 2.5, 3.2], [3.6, 1.65, 1.45]])


def silhouettes(camera: Camera, near_xy: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    vertices = camera.project(road_cuboids(near_xy, sizes))
    corners = [cv2.convexHull(v.astype(np.float32), returnPoints=False)[:, 0] for v in vertices]
    return vertices, [v[index] for v, index in zip(vertices, corners, strict=True)]


@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize("rule", [rule for rule in Rule if rule.is_of_tangents])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), y_m=st.floats(-15, 15))
def test_a_cuboid_from_its_silhouette(pair: Pair, rule: Rule, seed: int, y_m: float) -> None:
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, roll_deg=3.0)
    camera = replace(camera, scale=camera.scale * 9 / camera.height_m)  # type: ignore[operator]
    x = rng.uniform(3, 6, 3) * camera.height_m
    vertices, outlines = silhouettes(camera, np.stack([x, np.full(3, y_m)], axis=1), SIZES)
    found, valid = tangent_boxes(replace(camera, scale=None), outlines, pair, rule)
    assert valid.all()
    np.testing.assert_allclose(cuboid_sizes(found, camera), SIZES, rtol=1e-6)
    np.testing.assert_allclose(found[:, 4:6].mean(axis=1), vertices[:, 4:6].mean(axis=1), atol=1e-4)


@pytest.mark.parametrize("y_m", [-9.0, 0.4, 8.0])
def test_both_configurations_of_the_visible_side(y_m: float) -> None:
    """Left of the camera, ahead of it, right of it: vertices 1 and 2 stand on the side that is seen."""
    camera = Camera([1300.0, -350.0], [-5000.0, 560.0], [960.5, 540.5], 0.02, image_wh=(1920, 1080))
    vertices, outlines = silhouettes(camera, np.array([[30.0, y_m]]), SIZES[:1])
    found, valid = tangent_boxes(camera, outlines)
    assert valid.all()
    np.testing.assert_allclose(found, vertices, atol=1e-6)


def test_outlines_that_admit_no_box() -> None:
    camera = Camera([1100.0, 300.0], [-50000.0, 300.0], [960.5, 540.5], image_wh=(1920, 1080))
    around_vp1 = np.array([[1050.0, 250.0], [1150.0, 250.0], [1150.0, 400.0], [1050.0, 400.0]])
    on_road = np.array([[800.0, 700.0], [900.0, 700.0], [900.0, 790.0], [800.0, 790.0]])
    found, valid = tangent_boxes(camera, [around_vp1, on_road])
    assert valid.tolist() == [False, True]
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()
    assert tangent_boxes(camera, [])[0].shape == (0, 8, 2)
