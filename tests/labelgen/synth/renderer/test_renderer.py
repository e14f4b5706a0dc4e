"""Masks of rendered vehicles: occlusion, and agreement of pictures and truth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from labelgen.geometry.camera import look_at_road
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle, painting_order
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.shading.rasterizer import visible_triangles
from labelgen.synth.vehicle.vehicle import VehicleModel, make_vehicle

pytestmark = pytest.mark.slow

CAMERA = look_at_road(7.0, (25.0, 1.0), 667.0, (640, 360))


@cache
def vehicle_of(kind: str, seed: int) -> VehicleModel:
    return make_vehicle(kind, np.random.default_rng(seed))


def scene_with(places: list[tuple[float, float]]) -> tuple[Renderer, list[PlacedVehicle]]:
    light = make_light(Weather.DAY, np.random.default_rng(0))
    renderer = Renderer(CAMERA, np.full((360, 640, 3), 90, np.uint8), light, seed=0)
    return renderer, [
        PlacedVehicle(k, vehicle_of("hatchback", k), np.array(place), -1, 20.0) for k, place in enumerate(places)
    ]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_nearer_vehicles_hide_farther_ones(order: tuple[int, ...]) -> None:
    places = [(20.0, 0.0), (25.5, 0.3), (31.0, 0.0)]
    renderer, placed = scene_with([places[k] for k in order])
    visible = {order[vehicle.track_id]: vehicle.visible for vehicle in renderer.truth(placed)}
    assert visible[0] == 1
    assert visible[1] < 1
    assert visible[2] < 1
    assert [order[k] for k in painting_order(placed)] == [2, 1, 0]


def test_frames_and_truth_have_the_same_masks() -> None:
    renderer, placed = scene_with([(20.0, 2.0), (26.0, 0.5)])
    image, drawn = renderer.frame(placed)
    for a, b in zip(drawn, renderer.truth(placed), strict=True):
        assert a.track_id == b.track_id
        assert a.origin_px == b.origin_px
        np.testing.assert_array_equal(a.mask, b.mask)
    np.testing.assert_array_equal(image, renderer.frame(placed)[0])


def test_a_shadow_falls_away_from_the_sun() -> None:
    renderer, placed = scene_with([(25.0, 0.0)])
    image, _ = renderer.frame(placed)
    away = -np.sign(renderer.light.sun_direction[1])
    dark, bright = (renderer.camera.project([25.0, side * 1.25]).astype(int) for side in (away, -away))
    levels = [image[y - 2 : y + 3, x - 2 : x + 3].mean() for x, y in (dark, bright)]
    assert levels[0] < levels[1] - 10


@pytest.mark.parametrize(("kind", "at_most"), [("hatchback", 0.05), ("lorry", 0.08)])
def test_mirrors_are_drawn_but_belong_to_no_mask(kind: str, at_most: float) -> None:
    vehicle = vehicle_of(kind, 3)
    renderer, _ = scene_with([])
    placed = PlacedVehicle(1, vehicle, np.array([24.0, 1.0]), -1, 20.0)
    (drawn,) = renderer.truth([placed])
    world = placed.world()
    depth = (world - np.array([0.0, 0.0, CAMERA.height_m])) @ CAMERA.axes[:, 2]
    screen = np.concatenate([CAMERA.project(world), depth[:, None]], axis=1)
    everything, body = (
        visible_triangles(screen, triangles, (640, 360), (0.0, 0.0), 1, True) >= 0
        for triangles in (vehicle.mesh.triangles, vehicle.mesh.body)
    )
    mask = np.zeros_like(body)
    (x, y), (h, w) = drawn.origin_px, drawn.mask.shape
    mask[y : y + h, x : x + w] = drawn.mask
    np.testing.assert_array_equal(mask, body)
    assert 5 < np.count_nonzero(everything & ~body) < at_most * np.count_nonzero(body)
    np.testing.assert_allclose(vehicle.size_lwh, np.ptp(world[vehicle.mesh.body_vertices], axis=0))
