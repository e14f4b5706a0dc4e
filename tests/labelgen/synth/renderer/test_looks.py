"""What makes vehicles look real: bowed panels, soft shadows in gaps, glints, the camera's sharpening, far shadows."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest

from labelgen.geometry.camera import look_at_road
from labelgen.synth.renderer.renderer import Placed, Renderer
from labelgen.synth.scene.scene import procedural_scene
from labelgen.synth.scene.traffic import random_traffic
from labelgen.synth.sensor.glints import Glints
from labelgen.synth.sensor.sensor import PLAIN, Sensor
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.shading.materials import PAINT
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.texture import Texture
from labelgen.synth.vehicle.vehicle import make_vehicle

PANEL = [(1.0, 0.4), (3.0, 0.4), (3.0, 1.0), (1.0, 1.0)]


def painted() -> Texture:
    texture = Texture((4.0, 2.0, 1.5))
    texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), PAINT)
    return texture


def at(texture: Texture, d: float, z: float) -> tuple[int, int]:
    return round((1.5 - z) * texture.ppm), round(d * texture.ppm)


def test_a_bowed_panel_falls_away_from_its_middle_and_can_be_flattened() -> None:
    texture = painted()
    texture.bow(Chart.SIDE, PANEL, (0.5, 1.0), (0.0, 0.1))
    texture.flatten(Chart.SIDE, [(2.6, 0.8), (2.9, 0.8), (2.9, 0.9), (2.6, 0.9)])
    along, down = (texture.image[..., k].astype(int) - 128 for k in (4, 5))
    for d, slope in ((1.2, 40), (2.0, 0), (2.5, -25)):
        assert along[at(texture, d, 0.7)] == pytest.approx(slope, abs=3)
    for z, slope in ((0.9, 30), (0.7, 10), (0.5, -10)):
        assert down[at(texture, 2.0, z)] == pytest.approx(slope, abs=3)
    assert along[at(texture, 2.75, 0.85)] == down[at(texture, 2.75, 0.85)] == 0
    assert along[at(texture, 3.5, 0.7)] == 0


def test_a_soft_shadow_darkens_a_line_and_fades_beside_it() -> None:
    texture = painted()
    texture.shadow(Chart.SIDE, [(0.5, 0.7), (3.5, 0.7)], 0.5, 0.06)
    grey = (texture.image[..., 0].astype(float) / 255) ** 2
    assert grey[at(texture, 2.0, 0.7)] == pytest.approx(0.25, abs=0.02)
    assert 0.3 < grey[at(texture, 2.0, 0.735)] < 0.49
    assert grey[at(texture, 2.0, 1.0)] == pytest.approx(0.5, abs=0.01)


def gleaming() -> np.ndarray:
    layer = np.zeros((60, 80, 4), np.float32)
    layer[10:50, 10:70] = (120, 120, 120, 1)
    layer[30:32, 40:43, :3] = 255
    return layer


NOTHING = np.zeros((0, 0), np.uint8)


def test_stars_stand_over_gleams_alone() -> None:
    image = np.full((100, 120, 3), 80, np.uint8)
    Glints(8.0, np.random.default_rng(0)).add(image, gleaming(), (20, 30), NOTHING)
    rows, columns = np.nonzero((image != 80).any(axis=2))
    assert np.abs(rows - 60.5).max() <= 9
    assert np.abs(columns - 61).max() <= 9
    assert image[60:62, 60:63].max() > 250
    assert np.ptp(rows) >= 6


@pytest.mark.parametrize("case", ["no arms", "hidden", "even"])
def test_where_no_stars_are(case: str) -> None:
    image = np.full((100, 120, 3), 80, np.uint8)
    layer, hidden = gleaming(), NOTHING
    if case == "hidden":
        hidden = np.full((60, 80), 255, np.uint8)
    if case == "even":  # a white roof is no glint
        layer[10:50, 10:70, :3] = 255
    Glints(0.0 if case == "no arms" else 8.0, np.random.default_rng(0)).add(image, layer, (20, 30), hidden)
    assert (image == 80).all()


@pytest.mark.parametrize("size", [(60, 80), (61, 81)])
def test_sharpening_touches_brightness_alone(size: tuple[int, int]) -> None:
    image = np.full((*size, 3), (60, 90, 120), np.uint8)
    image[:, 40:] = (120, 180, 240)
    assert PLAIN.before_noise(image) is image
    out = Sensor(sharpen=1.5, peaking=0.5).before_noise(image).astype(int)
    assert out.shape == image.shape
    assert out[30, 36:40].mean(axis=1).min() < 90 - 10
    # Halos keep the colour: differences between the channels stay what they were.
    assert np.abs(out[30, 30:38, 2] - out[30, 30:38, 0] - 60).max() <= 6


def test_the_air_around_the_sun_is_bright() -> None:
    light = replace(make_light(Weather.DAY, np.random.default_rng(0)), sun_direction=np.array([0.6, 0.0, 0.8]))
    side = len(light.around)
    u = round((0.5 + 0.5 * 0.6 / 1.4) * side)
    here = light.around[side // 2, u]
    assert (here > light.around[side // 2, side - 1 - u] + 0.3).all()


def test_a_far_shadow_is_what_four_times_the_resolution_makes_of_it() -> None:
    light = make_light(Weather.DAY, np.random.default_rng(1))
    light = replace(light, sun_direction=np.array([0.58, -0.34, 0.74]), noise=0.01)
    plain, fine = (
        Renderer(
            look_at_road(7.4, (26.7, 0.4), 900.0 * k, (848 * k, 478 * k)),
            np.full((478 * k, 848 * k, 3), 110, np.uint8),
            light,
            seed=1,
        )
        for k in (1, 4)
    )
    car = make_vehicle("hatchback", np.random.default_rng(2))
    for x in (40.0, 75.0, 110.0):
        placed = [Placed(1, car, np.array([x, 0.5]), -1, 0.0)]
        image, drawn = plain.frame(placed)
        wanted = cv2.resize(fine.frame(placed)[0], (848, 478), interpolation=cv2.INTER_AREA)
        (left, top), mask = drawn[0].origin_px, drawn[0].mask
        foot = top + int(np.flatnonzero(mask.any(axis=1))[-1])
        error = np.abs(image.astype(int) - wanted)[foot + 1 : foot + 9, left - 20 : left + mask.shape[1]]
        assert np.percentile(error, 95) <= 8


def test_a_scene_can_be_seen_from_a_given_camera() -> None:
    camera = look_at_road(7.0, (22.0, 0.3), 620.0, (640, 360))
    scene = procedural_scene(np.random.default_rng(0), (640, 360), heading=1, seen_from=(camera, -0.5))
    assert scene.camera is camera
    measured = [lane.y0 for lane in scene.lanes if lane.index is not None]
    assert np.mean(measured) == pytest.approx(-0.5)


def test_motorcycles_are_not_rare_and_ride_beside_the_middle() -> None:
    scene = procedural_scene(np.random.default_rng(3), (1280, 720))
    trips = random_traffic(scene, 900.0, 5, per_minute=40)
    kinds = Counter(t.kind for t in trips)
    assert 0.025 < kinds["motorcycle"] / len(trips) < 0.08
    aside = [abs(t.offset_y) for t in trips if t.kind == "motorcycle"]
    assert np.median(aside) > 0.2
    assert max(aside) <= 1.1
