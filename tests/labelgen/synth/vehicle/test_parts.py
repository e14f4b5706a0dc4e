"""Parts of the renderer whose behaviour can be said in a line."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco

from labelgen.geometry.camera import look_at_road
from labelgen.synth.renderer.renderer import Placed, Renderer, painting_order
from labelgen.synth.scene.scene import procedural_scene, road_to_image
from labelgen.synth.scene.traffic import random_traffic
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.shading.rasterizer import visible_triangles
from labelgen.synth.truth.writer import encode_mask
from labelgen.synth.vehicle.body_mesh import body_mesh, setback
from labelgen.synth.vehicle.body_types import BODY_TYPES, mean_shape, sample_shape
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.vehicle import make_vehicle, vehicle_size


@pytest.mark.parametrize("kind", BODY_TYPES)
def test_bodies_have_real_sizes_and_stand_on_the_road(kind: str) -> None:
    for seed in range(4):
        vehicle = make_vehicle(kind, np.random.default_rng(seed))
        base = BODY_TYPES[kind]
        np.testing.assert_allclose(vehicle.size_lwh, [base.length, base.width, base.height], rtol=0.17)
        body = vehicle.mesh.vertices[vehicle.mesh.body_vertices]
        np.testing.assert_allclose(np.ptp(body, axis=0), vehicle.size_lwh)
        assert vehicle.mesh.vertices[:, 2].min() == pytest.approx(0)
        np.testing.assert_allclose(np.linalg.norm(vehicle.mesh.normals, axis=-1), 1, atol=1e-4)
        assert np.array_equal(vehicle_size(kind, np.random.default_rng(seed)), vehicle.size_lwh)


def test_bodies_are_closed_seen_from_outside() -> None:
    """The volume by the divergence theorem is positive and below the cuboid's."""
    for kind in BODY_TYPES:
        mesh = make_vehicle(kind, np.random.default_rng(0)).mesh
        a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
        volume = (np.cross(a, b) * c).sum() / 6
        least = 0.1 if kind == "motorcycle" else 0.3
        assert least < volume / np.ptp(mesh.vertices, axis=0).prod() < 1.0, kind


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 12), st.integers(1, 12), st.integers(0, 5), st.integers(0, 5), st.booleans(), st.integers(0, 1 << 30)
)
def test_run_lengths_are_those_of_pycocotools(h: int, w: int, x: int, y: int, fits: bool, seed: int) -> None:
    part = np.random.default_rng(seed).random((h, w)) < 0.6
    size = (x + w, y + h) if fits else (x + w + 3, y + h + 2)
    whole = np.zeros(size[::-1], dtype=np.uint8, order="F")
    whole[y : y + h, x : x + w] = part
    expected = coco.encode(whole)["counts"].decode()
    assert encode_mask(part, (x, y), size)["counts"] == expected


def test_the_road_homography_agrees_with_the_camera() -> None:
    camera = look_at_road(7.0, (25.0, 3.0), 1500.0, (1920, 1080), 1.0)
    assert camera.height_m == pytest.approx(7.0)
    points = np.array([[12.0, -3.0], [40.0, 5.0], [80.0, 0.0]])
    mapped = np.column_stack([points, np.ones(3)]) @ road_to_image(camera).T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], camera.project(points), atol=1e-6)
    np.testing.assert_allclose(camera.project([25.0, 3.0]), [960, 540], atol=1e-6)


def scene_with(places: list[tuple[float, float]]) -> tuple[Renderer, list[Placed]]:
    camera = look_at_road(7.0, (25.0, 1.0), 1000.0, (960, 540))
    light = make_light(Weather.DAY, np.random.default_rng(0))
    renderer = Renderer(camera, np.full((540, 960, 3), 90, np.uint8), light, seed=0)
    vehicles = [make_vehicle("hatchback", np.random.default_rng(k)) for k in range(len(places))]
    return renderer, [
        Placed(k, v, np.array(place), -1, 20.0) for k, (v, place) in enumerate(zip(vehicles, places, strict=True))
    ]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_nearer_vehicles_hide_farther_ones(order: tuple[int, ...]) -> None:
    places = [(20.0, 0.0), (25.5, 0.3), (31.0, 0.0)]
    renderer, placed = scene_with([places[k] for k in order])
    drawn = {order[d.track_id]: d.visible for d in renderer.truth(placed)}
    assert drawn[0] == 1
    assert drawn[1] < 1
    assert drawn[2] < 1
    assert [order[k] for k in painting_order(placed)] == [2, 1, 0]


def test_drawing_and_truth_give_the_same_masks() -> None:
    renderer, placed = scene_with([(20.0, 2.0), (26.0, 0.5)])
    _, drawn = renderer.frame(placed)
    for a, b in zip(drawn, renderer.truth(placed), strict=True):
        assert a.track_id == b.track_id
        assert a.origin_px == b.origin_px
        assert np.array_equal(a.mask, b.mask)


def test_a_shadow_falls_away_from_the_sun() -> None:
    renderer, placed = scene_with([(25.0, 0.0)])
    image, _ = renderer.frame(placed)
    # Of two spots beside the car, the one on the far side from the sun is darker.
    away = -np.sign(renderer.light.sun_direction[1])
    dark, bright = (renderer.camera.project([25.0, side * 1.25]).astype(int) for side in (away, -away))
    values = [image[y - 2 : y + 3, x - 2 : x + 3].mean() for x, y in (dark, bright)]
    assert values[0] < values[1] - 10


def test_vehicles_of_a_lane_never_meet() -> None:
    scene = procedural_scene(np.random.default_rng(3), (1280, 720))
    trips = random_traffic(scene, 60.0, 5, per_minute=40)
    assert len(trips) > 40
    for time in np.arange(0.0, 60.0, 0.5):
        for lane in scene.lanes:
            low, high = scene.x_range
            here = sorted((t.near_x(time), t.near_x(time) + t.size_lwh[0]) for t in trips if t.lane is lane)
            here = [span for span in here if span[1] > low and span[0] < high]
            assert all(a[1] < b[0] for a, b in pairwise(here))


@pytest.mark.parametrize(("kind", "at_most"), [("hatchback", 0.05), ("lorry", 0.08), ("bus", 0.05)])
def test_mirrors_and_aerials_are_drawn_but_belong_to_no_mask(kind: str, at_most: float) -> None:
    camera = look_at_road(8.0, (24.0, 0.3), 700.0, (1280, 720))
    renderer = Renderer(
        camera, np.full((720, 1280, 3), 90, np.uint8), make_light(Weather.DAY, np.random.default_rng(0)), seed=0
    )
    vehicle = make_vehicle(kind, np.random.default_rng(3))
    placed = Placed(1, vehicle, np.array([24.0, 1.0]), -1, 20.0)
    _, (drawn,) = renderer.frame([placed])
    world = placed.world()
    depth = (world - np.array([0.0, 0.0, camera.height_m])) @ camera.axes[:, 2]
    screen = np.concatenate([camera.project(world), depth[:, None]], axis=1)
    everything, body = (
        visible_triangles(screen, triangles, (1280, 720), (0.0, 0.0), 1, True) >= 0
        for triangles in (vehicle.mesh.triangles, vehicle.mesh.body)
    )
    mask = np.zeros_like(body)
    (x, y), (h, w) = drawn.origin_px, drawn.mask.shape
    mask[y : y + h, x : x + w] = drawn.mask
    assert (mask == body).all()
    assert 20 < np.count_nonzero(everything & ~body) < at_most * np.count_nonzero(body)
    np.testing.assert_allclose(vehicle.size_lwh, np.ptp(world[vehicle.mesh.body_vertices], axis=0))


def test_some_cars_have_an_aerial_that_stands_above_the_body() -> None:
    above = []
    for seed in range(40):
        car = make_vehicle("estate", np.random.default_rng(seed))
        above.append(float(car.mesh.vertices[:, 2].max() - car.size_lwh[2]))
    assert 2 <= sum(height > 0.1 for height in above) <= 20
    assert max(above) < 0.45


@pytest.mark.parametrize("kind", ["supermini", "hatchback", "saloon", "suv", "van", "bus", "lorry"])
def test_noses_are_as_round_in_plan_as_what_is_painted_on_them(kind: str) -> None:
    shape = mean_shape(kind)
    body = body_mesh(shape).vertices
    front = body[:, 0].max()
    for share in (0.3, 0.6, 0.8):
        y = share * shape.width / 2
        beside = body[np.abs(np.abs(body[:, 1]) - y) < 0.04 * shape.width]
        assert front - beside[:, 0].max() == pytest.approx(float(setback(shape, 0.0, y)), abs=0.03)
    assert 0.05 < setback(shape, 0.0, shape.width / 2) < 0.35


@pytest.mark.parametrize("kind", [kind for kind, shape in BODY_TYPES.items() if shape.kind != "motorcycle"])
def test_a_screen_shows_one_drawing(kind: str) -> None:
    """Two drawings beside each other would show two dashboards."""
    for seed in range(6):
        shape = sample_shape(kind, np.random.default_rng(seed))
        mesh = body_mesh(shape)
        middles, normals = mesh.vertices[mesh.triangles].mean(axis=1), mesh.normals.mean(axis=1)
        d = shape.length / 2 - middles[:, 0]
        d -= setback(shape, d, middles[:, 1])
        first, last = shape.cowl[0] + 0.03, shape.roof_front[0] - 0.03
        screen = (d > first) & (d < last) & (middles[:, 2] > shape.belt + 0.1) & (np.abs(middles[:, 1]) < 0.5)
        charts = set(mesh.charts[screen & (normals[:, 2] > 0)].tolist())
        assert len(charts) == 1
        assert charts <= {Chart.TOP, Chart.FRONT}
