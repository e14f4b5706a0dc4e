"""What vehicles are painted with, and what their paint mirrors."""

from __future__ import annotations

import numpy as np
import pytest
from shapely.geometry import LineString, Point, Polygon
from shapely.ops import unary_union

from labelgen.geometry.camera import look_at_road
from labelgen.synth.renderer.renderer import Placed, Renderer
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.shading.materials import CHROME, GLASS, LAMP, LIT, MATTE, PAINT, PLATE
from labelgen.synth.vehicle.body_mesh import body_mesh
from labelgen.synth.vehicle.body_types import BODY_TYPES
from labelgen.synth.vehicle.front_designs import CAR_DESIGNS, VAN_DESIGNS, FrontDesign
from labelgen.synth.vehicle.lettering import letter_van
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.parts import sample_style
from labelgen.synth.vehicle.tail_lamp_designs import CAR_TAILS, VAN_TAILS, TailDesign
from labelgen.synth.vehicle.texture import Texture
from labelgen.synth.vehicle.vehicle import make_vehicle


@pytest.mark.parametrize("kind", BODY_TYPES)
def test_every_body_has_glass_lamps_and_a_plate(kind: str) -> None:
    texture = make_vehicle(kind, np.random.default_rng(0)).texture
    materials = set(np.unique(texture.image[..., 3]).tolist())
    assert {PAINT, GLASS, PLATE} <= materials
    assert materials <= {MATTE, PAINT, GLASS, LAMP, CHROME, PLATE, LIT}
    assert materials & {LAMP, LIT}
    assert LIT in np.unique(make_vehicle(kind, np.random.default_rng(0), lamps=True).texture.image[..., 3])


def test_the_same_generator_paints_the_same_and_others_differ() -> None:
    a, b, c = (make_vehicle("hatchback", np.random.default_rng(seed)).texture.image for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert a.shape != c.shape or not np.array_equal(a, c)


def test_styles_come_in_families() -> None:
    styles = [sample_style(BODY_TYPES["suv"], np.random.default_rng(seed)) for seed in range(200)]
    for name, count in (("plate", 4), ("rails", 3)):
        assert {getattr(s, name) for s in styles} == set(range(count))
    assert {s.front.name for s in styles} == {design.name for design in CAR_DESIGNS}
    assert {s.tail.outline for s in styles} == {design.outline for design in CAR_TAILS}


@pytest.mark.parametrize("design", CAR_DESIGNS + VAN_DESIGNS, ids=lambda design: design.name)
def test_fronts_lie_within_the_face(design: FrontDesign) -> None:
    """And lamps do not run into grilles, or beyond the bonnet's edge by more than a tapering end."""
    lines = [design.lamp, design.amber, design.hollow, *design.strips, *(o.half for o in design.openings)]
    lines += [points for points, _ in (*design.bright, *design.painted)]
    for y, t in (point for line in lines for point in line):
        assert 0 <= y <= 1
        assert 0 <= t <= 1.2
    lamp = Polygon(design.lamp)
    assert lamp.is_valid
    for line in (*design.strips, design.amber):
        assert not line or lamp.buffer(0.03).contains(LineString(line))
    dark = unary_union([Polygon(design.hollow), *(Polygon(o.half) for o in design.openings)])
    for y, t, radius in design.fog:
        assert dark.buffer(0.03).contains(Point(y, t)) or (not design.hollow and t < 0.3)
        assert 0.02 < radius < 0.08
    for opening in design.openings:
        assert Polygon(opening.half).is_valid
        assert Polygon(opening.half).intersection(lamp).area < 0.03 * lamp.area
    for y, t, radius in design.bowls:
        assert lamp.buffer(0.03).contains(Point(y, t))
        assert 0.02 < radius < 0.08


@pytest.mark.parametrize("design", CAR_TAILS + VAN_TAILS)
def test_tail_lamps_hold_what_is_in_them(design: TailDesign) -> None:
    glass = Polygon(design.outline)
    assert glass.is_valid
    for field in (design.clear, design.amber):
        assert not field or glass.buffer(0.03).contains(Polygon(field))
    for strip in design.strips:
        assert glass.buffer(0.05).contains(LineString(strip))
    for y, down, radius in design.bowls:
        assert glass.contains(Point(y, down))
        assert 0.02 < radius < 0.08


@pytest.mark.parametrize("kind", ["supermini", "saloon", "suv", "van"])
def test_lamps_reach_up_to_the_bonnet_in_one_piece(kind: str) -> None:
    """Where lamps are, near the corners below the bonnet's edge, the body shows the front's drawing alone."""
    mesh = body_mesh(BODY_TYPES[kind])
    _, width, _ = np.ptp(mesh.vertices, axis=0)
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    ahead = mesh.vertices[:, 0].max() - middles[:, 0]
    beside = np.abs(middles[:, 1]) / (width / 2)
    foot, edge = BODY_TYPES[kind].clearance + 0.08, BODY_TYPES[kind].nose - 0.05
    share = (middles[:, 2] - foot) / (edge - foot)
    bow = BODY_TYPES[kind].round_nose * beside**2
    here = (mesh.normals.mean(axis=1)[:, 0] > 0.35) & (share > 0.6) & (share < 0.97) & (beside < 0.85)
    here &= (ahead - bow < 0.15) & (mesh.charts != Chart.WHEEL) & (mesh.charts != Chart.DARK)
    assert here.sum() > 20
    assert set(np.unique(mesh.charts[here]).tolist()) == {Chart.FRONT}


def test_words_are_as_tall_and_wide_as_said() -> None:
    texture = Texture((8.0, 2.5, 3.5))
    texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), PAINT)
    wide = texture.text(Chart.SIDE, (2.0, 2.0), "MOTO", 0.4, (0.0, 0.0, 0.0), PAINT)
    rows, columns = np.nonzero(texture.image[: round(3.5 * texture.ppm), :, 0] < 100)
    assert (np.ptp(rows) + 1) / texture.ppm == pytest.approx(0.4, abs=0.12)
    assert 3.5 - rows.max() / texture.ppm == pytest.approx(2.0, abs=0.06)
    assert columns.min() / texture.ppm == pytest.approx(2.0, abs=0.06)
    assert (np.ptp(columns) + 1) / texture.ppm == pytest.approx(wide, abs=0.1)


def test_letters_are_of_their_own_material_alone() -> None:
    texture = Texture((8.0, 2.5, 3.5))
    texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), PAINT)
    texture.text(Chart.SIDE, (2.0, 2.0), "CARGO", 0.4, (0.1, 0.0, 0.0), LAMP)
    side = texture.image[: round(3.5 * texture.ppm)]
    assert set(np.unique(side[..., 3]).tolist()) == {PAINT, LAMP}
    assert len(np.unique(side[..., 0])) == 2


@pytest.mark.parametrize("first", [1.9, 3.4, 4.9])
def test_names_on_vans_begin_behind_the_windows(first: float) -> None:
    """And there are none where too little of the side is left."""
    shape = BODY_TYPES["van"]
    for seed in range(12):
        plain, texture = (Texture((shape.length, shape.width, shape.height)) for _ in range(2))
        letter_van(texture, shape, first, np.random.default_rng(seed))
        side = slice(0, round(shape.height * texture.ppm))
        changed = np.flatnonzero((texture.image != plain.image)[side].any(axis=(0, 2)))
        if first > shape.length - 1.0:
            assert not len(changed)
        else:
            assert len(changed)
            assert changed.min() / texture.ppm > first - 0.05


def test_weather_takes_light_from_paint_alone_and_nowhere_adds_any() -> None:
    textures = [Texture((4.0, 2.0, 1.5)) for _ in range(2)]
    for texture in textures:
        texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), PAINT)
        texture.rectangle(Chart.SIDE, (1.0, 0.5), (2.0, 1.0), (0.5, 0.5, 0.5), GLASS)
    textures[1].weather(Chart.SIDE, 0.4, 0.2, np.random.default_rng(0))
    before, after = (texture.image[: round(1.5 * texture.ppm), : round(4.0 * texture.ppm)] for texture in textures)
    paint = before[..., 3] == PAINT
    assert np.array_equal(before[~paint], after[~paint])
    assert (after[paint][:, :3] <= before[paint][:, :3]).all()
    assert after[paint][:, 0].std() > 3


def test_drawings_seen_foreshortened_are_softened_along_the_road_alone() -> None:
    texture = Texture((4.0, 2.0, 1.5))
    texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), PAINT)
    texture.line(Chart.SIDE, [(2.0, 0.2), (2.0, 1.3)], (0.0, 0.0, 0.0), PAINT, 0.011)
    texture.line(Chart.SIDE, [(0.2, 0.7), (1.5, 0.7)], (0.0, 0.0, 0.0), PAINT, 0.011)
    image, _ = texture.level(0.0)
    row, column = round((1.5 - 1.0) * texture.ppm), round(2.0 * texture.ppm)
    upright = np.count_nonzero(image[row, column - 6 : column + 7, 0] < 178)
    lying = np.count_nonzero(
        image[round(0.8 * texture.ppm) - 6 : round(0.8 * texture.ppm) + 7, round(0.8 * texture.ppm), 0] < 178
    )
    assert upright == lying + 4


def test_relief_tilts_towards_its_edges_alone() -> None:
    texture = Texture((4.0, 2.0, 1.5))
    texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), PAINT)
    texture.emboss(Chart.SIDE, [(1, 0.4), (3, 0.4), (3, 1.0), (1, 1.0)], 0.02)
    along, down = (texture.image[..., k].astype(int) - 128 for k in (4, 5))
    row, column = round((1.5 - 0.7) * texture.ppm), round(1.0 * texture.ppm)
    assert along[row, column] > 20
    assert along[row, round(3.0 * texture.ppm)] < -20
    assert down[row, column] == 0
    assert along[row, round(2.0 * texture.ppm)] == 0
    # Coarser levels keep materials apart and slopes together.
    image, maps = texture.level(0.05)
    assert set(np.unique(image[..., 3])) <= {0, PAINT}
    np.testing.assert_allclose(maps * 4, texture.maps)


def test_paint_mirrors_the_sky_above_and_the_road_below() -> None:
    for weather in Weather:
        light = make_light(weather, np.random.default_rng(3))
        around = light.around
        side = len(around)
        assert np.isfinite(around).all()
        assert (around >= 0).all()
        middle = slice(side // 2 - 6, side // 2 + 6)
        assert around[middle, middle].mean() > 0.5 * light.sky_high.mean()
        np.testing.assert_allclose(around[:3, :3].mean(axis=(0, 1)), light.road_radiance, rtol=0.6)


def test_a_black_roof_shows_the_sky() -> None:
    """Seen under an even grey sky, dark paint is brighter where it faces up than its albedo makes it."""
    camera = look_at_road(7.0, (16.0, 0.5), 900.0, (320, 240))
    light = make_light(Weather.OVERCAST, np.random.default_rng(0))
    car = next(
        v
        for v in (make_vehicle("saloon", np.random.default_rng(seed)) for seed in range(60))
        if np.median(v.texture.image[..., :3][v.texture.image[..., 3] == PAINT]) < 45
    )
    renderer = Renderer(camera, np.full((240, 320, 3), 90, np.uint8), light, seed=0)
    image, drawn = renderer.frame([Placed(1, car, np.array([16.0, 0.5]), -1, 1.0)])
    x, y = drawn[0].origin_px
    inside = image[y : y + drawn[0].mask.shape[0], x : x + drawn[0].mask.shape[1]][drawn[0].mask]
    dark = light.grey_levels(np.full((1, 3), 0.02) * light.ambient).mean()
    assert np.percentile(inside, 90) > dark + 15
