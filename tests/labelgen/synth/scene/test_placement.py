"""Props beside made-up roads: where they stand, what they hide, and that truth respects them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labelgen.geometry.camera import look_at_road
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.scene.placement import Prop, place_props
from labelgen.synth.scene.props import ALONG, AT
from labelgen.synth.scene.road_image import draw_scene
from labelgen.synth.scene.scene import carriageways, procedural_scene, visible_range
from labelgen.synth.scene.static_layer import NO_SHADE, draw_props, without_view_blockers
from labelgen.synth.scene.triangles import box
from labelgen.synth.sensor.sensor import Caption, Sensor, make_sensor
from labelgen.synth.shading.lighting import Light, Weather, make_light, varied_light
from labelgen.synth.truth.session import write_session
from labelgen.synth.vehicle.vehicle import make_vehicle

pytestmark = pytest.mark.slow

SIZE = (480, 270)
CAMERA = look_at_road(7.0, (25.0, 0.5), 525.0, SIZE)


def light() -> Light:
    return make_light(Weather.DAY, np.random.default_rng(0))


def renderer_behind(props: list[Prop], sensor: Sensor | None = None) -> tuple[Renderer, np.ndarray]:
    image, static_layer = draw_props(np.full((270, 480, 3), 90, np.float32), CAMERA, light(), props, NO_SHADE)
    background = image.astype(np.uint8)
    more = {} if sensor is None else {"sensor": sensor}
    return Renderer(CAMERA, background, light(), seed=0, static_layer=static_layer, **more), background


def car(x: float, y: float) -> PlacedVehicle:
    return PlacedVehicle(1, make_vehicle("saloon", np.random.default_rng(0)), np.array([x, y]), -1, 20.0)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_on_a_lane_or_in_front_of_much_of_the_road(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = procedural_scene(rng, SIZE)
    props = place_props(scene, 1.0, rng)
    for prop in props:
        assert prop.kind in {*ALONG, *AT, "gantry"}
        low = prop.triangles.corners[prop.triangles.corners[..., 2] < 4.5]
        for y0, y1, _ in carriageways(scene):
            assert not ((low[:, 1] > y0) & (low[:, 1] < y1)).any(), prop.kind
    kept = without_view_blockers(scene, props)
    assert len(kept) >= 0.5 * len(props)
    near, _ = visible_range(scene.camera, carriageways(scene)[0][0]) or (10.0, 40.0)
    wall = Prop("wall", box((near + 8, -20, 0), (near + 8.5, 20, 3), (0.3, 0.3, 0.3)))
    assert wall not in without_view_blockers(scene, [*props, wall])


@pytest.mark.parametrize(
    ("low", "high", "hides"),
    [
        ((16.0, -3.0, 0.0), (16.3, 3.0, 3.0), True),
        ((34.0, -3.0, 0.0), (34.3, 3.0, 6.0), False),
        ((12.0, 3.0, 0.0), (24.0, 3.2, 2.5), None),
    ],
)
def test_props_before_a_vehicle_hide_it_and_those_behind_do_not(
    low: tuple[float, ...], high: tuple[float, ...], hides: bool | None
) -> None:
    props = [Prop("wall", box(low, high, (0.5, 0.1, 0.1), piece_m=1.0))]
    renderer, background = renderer_behind(props)
    placed = car(25.0, 0.0) if hides is not None else car(18.0, 5.0)
    alone = Renderer(CAMERA, background, light(), seed=0).truth([placed])[0]
    (behind,) = renderer.truth([placed])
    if hides is False:
        assert behind.visible == 1
        np.testing.assert_array_equal(behind.mask, alone.mask)
        return
    # A pixel that left the mask shows the background, save for noise and the lens's blur.
    assert behind.visible < 1
    frame, drawn = renderer.frame([placed])
    x, y = drawn[0].origin_px
    hidden = alone.mask & ~drawn[0].mask
    assert hidden.sum() > 20
    h, w = hidden.shape
    cover = renderer.static_layer.cover[y : y + h, x : x + w]
    assert (cover[hidden] >= 128).all()
    assert not (drawn[0].mask & (cover >= 128)).any()
    change = np.abs(frame[y : y + h, x : x + w].astype(int) - background[y : y + h, x : x + w])
    assert change[hidden & (cover == 255)].mean() < 6


@pytest.mark.parametrize("kind", [*ALONG, *AT])
def test_every_kind_is_a_mesh_that_stands_on_the_ground(kind: str) -> None:
    rng = np.random.default_rng(1)
    triangles = ALONG[kind](15.0, 40.0, 5.0, 1, rng) if kind in ALONG else AT[kind](25.0, 5.0, 1, rng)
    assert len(triangles) > 3
    assert np.isfinite(triangles.corners).all()
    assert -0.01 <= triangles.corners[..., 2].min() < 0.5
    assert (triangles.albedo >= 0).all()
    assert (triangles.albedo <= 1).all()
    np.testing.assert_allclose(np.linalg.norm(triangles.normals, axis=1)[triangles.leafy], 1, atol=1e-4)


def test_a_seed_determines_the_picture() -> None:
    pictures = []
    for _ in range(2):
        rng = np.random.default_rng(7)
        scene = procedural_scene(rng, SIZE)
        lit = varied_light(make_light(Weather.DAY, rng), rng)
        image, static_layer = draw_scene(scene, lit, rng)
        assert static_layer is not None
        pictures.append((image, static_layer.cover, static_layer.place, static_layer.shade.sun, make_sensor(rng)))
    for a, b in zip(*pictures, strict=True):
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


def test_a_camera_changes_pixels_and_no_truth() -> None:
    captions = (Caption("{clock} CAM", (0.02, 0.1), 0.05, 0, True, True),)
    plain, _ = renderer_behind([])
    faulty, _ = renderer_behind([], sensor=Sensor(0.5, 0.005, 1.0, 0.5, 28, captions, 3600.0))
    placed = car(25.0, 0.0)
    a, b = plain.frame([placed]), faulty.frame([placed])
    np.testing.assert_array_equal(a[1][0].mask, b[1][0].mask)
    assert not np.array_equal(a[0], b[0])
    # Between two times only the burnt-in clock differs.
    later, _ = faulty.frame([placed], time_s=5.0)
    rows = np.flatnonzero((later != b[0]).any(axis=(1, 2)))
    assert len(rows)
    assert rows.max() < 0.15 * SIZE[1]


def test_motorcycles_have_their_own_category(tmp_path: Path) -> None:
    write_session(tmp_path, duration_s=2, fps=2, size_wh=(320, 180), seed=4, kinds=["motorcycle"], per_minute=40)
    data = json.loads((tmp_path / "truth" / "session0_center" / "masks.json").read_text(encoding="utf-8"))
    assert {a["category_id"] for a in data["annotations"]} == {4}
    assert {"id": 4, "name": "motorcycle"} in data["categories"]
