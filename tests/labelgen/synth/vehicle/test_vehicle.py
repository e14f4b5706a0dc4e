"""Bodies of rendered vehicles: sizes, closed meshes, and that a seed determines everything."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.synth.vehicle.body_mesh import body_mesh, setback
from labelgen.synth.vehicle.body_types import BODY_TYPES, mean_shape
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.texture import Texture
from labelgen.synth.vehicle.vehicle import VehicleModel, check_kinds, check_plates, make_vehicle, vehicle_size

pytestmark = pytest.mark.slow


@cache
def vehicle_of(kind: str, seed: int) -> VehicleModel:
    return make_vehicle(kind, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", BODY_TYPES)
def test_bodies_have_real_sizes_and_stand_on_the_road(kind: str) -> None:
    for seed in range(2):
        vehicle = vehicle_of(kind, seed)
        base = BODY_TYPES[kind]
        np.testing.assert_allclose(vehicle.size_lwh, [base.length, base.width, base.height], rtol=0.17)
        body = vehicle.mesh.vertices[vehicle.mesh.body_vertices]
        np.testing.assert_allclose(np.ptp(body, axis=0), vehicle.size_lwh)
        assert vehicle.mesh.vertices[:, 2].min() == pytest.approx(0)
        np.testing.assert_allclose(np.linalg.norm(vehicle.mesh.normals, axis=-1), 1, atol=1e-4)


def test_a_size_needs_no_texture() -> None:
    for kind in ("hatchback", "bus", "motorcycle", "box"):
        size = vehicle_size(kind, np.random.default_rng(0))
        np.testing.assert_array_equal(size, vehicle_of(kind, 0).size_lwh)


@pytest.mark.parametrize("kind", BODY_TYPES)
def test_bodies_are_closed_and_face_outwards(kind: str) -> None:
    """The volume by the divergence theorem is positive and below that of the bounding cuboid."""
    mesh = vehicle_of(kind, 0).mesh
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    volume = (np.cross(a, b) * c).sum() / 6
    smallest_share = 0.1 if kind == "motorcycle" else 0.3
    assert smallest_share < volume / np.ptp(mesh.vertices, axis=0).prod() < 1.0


@pytest.mark.parametrize("kind", ["hatchback", "lorry"])
def test_setback_is_that_of_the_mesh(kind: str) -> None:
    shape = mean_shape(kind)
    body = body_mesh(shape).vertices
    front = body[:, 0].max()
    for share in (0.3, 0.6, 0.8):
        y = share * shape.width / 2
        beside = body[np.abs(np.abs(body[:, 1]) - y) < 0.04 * shape.width]
        assert front - beside[:, 0].max() == pytest.approx(float(setback(shape, 0.0, y)), abs=0.03)


def test_a_seed_determines_the_vehicle() -> None:
    again, other = (make_vehicle("hatchback", np.random.default_rng(seed)) for seed in (1, 2))
    first = vehicle_of("hatchback", 1)
    np.testing.assert_array_equal(first.texture.image, again.texture.image)
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    assert not np.array_equal(first.size_lwh, other.size_lwh)


def test_coarser_texture_levels_keep_materials_and_scale_the_maps() -> None:
    texture = Texture((4.0, 2.0, 1.5))
    texture.fill(Chart.SIDE, (0.5, 0.5, 0.5), 1)
    image, maps = texture.level(0.05)
    assert set(np.unique(image[..., 3])) <= {0, 1}
    np.testing.assert_allclose(maps * 4, texture.maps)


def test_unknown_names_are_refused() -> None:
    check_kinds([*BODY_TYPES, "box"])
    with pytest.raises(DataError, match="tank"):
        check_kinds(["tank"])
    check_plates(None)
    with pytest.raises(DataError, match="pink"):
        check_plates("pink")
