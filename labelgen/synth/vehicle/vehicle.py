"""Vehicles ready to be rendered: mesh, texture and paint, sampled from a body type."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.labels import VehicleClass
from labelgen.synth.shading.materials import PAINT
from labelgen.synth.vehicle.body_mesh import body_mesh, outside_parts
from labelgen.synth.vehicle.body_types import BODY_TYPES, Shape, sample_shape
from labelgen.synth.vehicle.mesh import Chart, Mesh, box_mesh, join
from labelgen.synth.vehicle.motorcycle import draw_motorcycle, motorcycle_mesh
from labelgen.synth.vehicle.paint_sides import draw_texture
from labelgen.synth.vehicle.parts import PLATES
from labelgen.synth.vehicle.texture import Texture

__all__ = ["VehicleModel", "body_kinds", "check_kinds", "check_plates", "make_vehicle", "vehicle_size"]

# Linear RGB, metalness and share. Shares as on European roads: white, grey, black, silver; blue, red, and the rest.
_PAINTS: tuple[tuple[tuple[float, float, float], float, float], ...] = (
    ((0.75, 0.75, 0.745), 0.0, 0.25),
    ((0.42, 0.43, 0.44), 0.7, 0.17),
    ((0.085, 0.088, 0.092), 0.6, 0.19),
    ((0.013, 0.0125, 0.014), 0.3, 0.20),
    ((0.022, 0.042, 0.085), 0.5, 0.08),
    ((0.11, 0.165, 0.25), 0.6, 0.03),
    ((0.22, 0.026, 0.026), 0.2, 0.045),
    ((0.095, 0.016, 0.018), 0.5, 0.02),
    ((0.022, 0.066, 0.042), 0.4, 0.02),
    ((0.21, 0.19, 0.155), 0.6, 0.025),
    ((0.46, 0.27, 0.06), 0.1, 0.005),
    ((0.40, 0.34, 0.15), 0.0, 0.005),
)

_WHITE = 0.6

# Liveries of buses, faded: white, silver, teal, grey, yellow, a dull red, a dull blue.
_BUS_PAINTS: tuple[tuple[tuple[float, float, float], float], ...] = (
    ((0.58, 0.585, 0.57), 0.36),
    ((0.34, 0.35, 0.355), 0.18),
    ((0.20, 0.33, 0.33), 0.14),
    ((0.16, 0.165, 0.17), 0.08),
    ((0.44, 0.34, 0.13), 0.12),
    ((0.17, 0.075, 0.066), 0.05),
    ((0.11, 0.16, 0.24), 0.06),
)

_CARGO_TONES = ((0.66, 0.66, 0.63), (0.46, 0.46, 0.47), (0.10, 0.12, 0.18), (0.21, 0.08, 0.07), (0.11, 0.14, 0.12))


@dataclass(frozen=True, eq=False)
class VehicleModel:
    """One vehicle to be rendered.

    Args:
        kind: body type, a key of `BODY_TYPES`, or "box".
        vehicle_class: for labels.
        size_lwh: (3,) metres, length, width and height of the body's bounding cuboid, without mirrors.
        mesh: in the vehicle's frame, whose origin is the centre of the cuboid's floor.
        texture: colours, materials and slopes of the surface.
        paint: (5,) see `rasterizer.shade`.
    """

    kind: str
    vehicle_class: VehicleClass
    size_lwh: NDArray[np.float64]
    mesh: Mesh
    texture: Texture
    paint: NDArray[np.float64]


def body_kinds(longest_m: float = np.inf) -> tuple[list[str], NDArray[np.float64]]:
    """Return the body types up to a length in metres, and their (K,) shares in traffic, which sum to 1."""
    kinds = [kind for kind, shape in BODY_TYPES.items() if shape.length * 1.05 <= longest_m] or ["supermini"]
    shares = np.array([BODY_TYPES[kind].share for kind in kinds])
    return kinds, shares / shares.sum()


def check_kinds(kinds: Iterable[str]) -> None:
    """Check names of body types.

    Raises:
        DataError: one of them is no key of `BODY_TYPES` and not "box".
    """
    for kind in kinds:
        if kind not in BODY_TYPES and kind != "box":
            raise DataError(
                f"kinds {kind}: unknown body type; use some of {', '.join(BODY_TYPES)}, box", parameter="kinds"
            )


def check_plates(plates: str | None) -> None:
    """Check the name of a family of number plates.

    Raises:
        DataError: it is not in `PLATES`.
    """
    if plates is not None and plates not in PLATES:
        raise DataError(f"plates {plates}: unknown; use one of {', '.join(PLATES)}", parameter="plates")


def make_vehicle(
    kind: str, rng: np.random.Generator, *, lamps: bool = False, plates: str | None = None
) -> VehicleModel:
    """Sample a vehicle of a body type: proportions, colour and details.

    Args:
        kind: a key of `BODY_TYPES`, or "box": a plain cuboid, whose outline is that of its 3D box.
        rng: the same state gives the same vehicle.
        lamps: whether its lamps are on.
        plates: one of `PLATES`; any when None.

    Raises:
        DataError: there is no such body type.
    """
    body = _body(kind, rng)
    if body.shape is None:
        texture = Texture(body.size_lwh.tolist())
        for chart in Chart:
            texture.fill(chart, body.colour, PAINT)
        return VehicleModel(
            kind, body.vehicle_class, body.size_lwh, body.mesh, texture, np.array([body.metal, 1, 0.9, 0, 0])
        )
    extent = np.ptp(body.mesh.vertices, axis=0).tolist()
    mesh = body.mesh if kind == "motorcycle" else _with_outside_parts(body.mesh, body.shape)
    cargo = _CARGO_TONES[int(rng.choice(len(_CARGO_TONES), p=[0.56, 0.2, 0.1, 0.07, 0.07]))]
    # Greys vary: some are bluish, some brown, a few greenish, none lilac. Whites hardly differ.
    spread = 0.006 + 0.05 * max(0.0, 1 - float(np.mean(body.colour)) / 0.6)
    warm, aside, fresh = rng.normal(0, spread, 3).clip(-0.2, 0.2).tolist()
    tint = np.array([1 + warm, 1 + 0.4 * abs(fresh), 1 - warm + 0.3 * aside])
    red, green, blue = (np.array(body.colour) * tint).clip(0, 0.75).tolist()
    colour = (red, green, blue)
    if kind == "motorcycle":
        texture = Texture(extent)
        draw_motorcycle(texture, body.shape, colour, rng, lamps=lamps)
    else:
        texture = draw_texture(body.shape, extent, colour, cargo, rng, lamps=lamps, plates=plates)
    texture.level(0.0)  # computes every level now rather than in the first frame
    paint = np.array([body.metal, rng.uniform(0.7, 1.0), 0.9, 0.0, rng.uniform(0.02, 0.18)])
    return VehicleModel(kind, body.vehicle_class, body.size_lwh, mesh, texture, paint)


def vehicle_size(kind: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return (3,) `size_lwh` of `make_vehicle` for the same generator, without painting a texture."""
    return _body(kind, rng).size_lwh


@dataclass(frozen=True, eq=False)
class _Body:
    vehicle_class: VehicleClass
    shape: Shape | None
    mesh: Mesh
    size_lwh: NDArray[np.float64]
    colour: tuple[float, float, float]
    metal: float


def _body(kind: str, rng: np.random.Generator) -> _Body:
    tone, metal, _ = _PAINTS[int(rng.choice(len(_PAINTS), p=_shares()))]
    level = rng.uniform(0.8, 1.15)
    if min(tone) > _WHITE:  # whites vary less
        level = 1 + 0.3 * (level - 1)
    red, green, blue = np.clip(np.array(tone) * level, 0, 0.75).tolist()
    colour = (red, green, blue)
    if kind == "box":
        size = rng.uniform([3.6, 1.65, 1.4], [5.0, 1.95, 2.2])
        half = size / 2
        mesh = box_mesh((-half[0], -half[1], 0), (half[0], half[1], size[2]))
        return _Body(VehicleClass.VEHICLE, None, mesh, size, colour, metal)
    check_kinds([kind])
    if kind in ("van", "lorry", "articulated") and rng.random() < 0.55:
        colour, metal = (0.70, 0.70, 0.69), 0.0
    if kind == "bus":
        shares = np.array([share for _, share in _BUS_PAINTS])
        faded = _BUS_PAINTS[int(rng.choice(len(_BUS_PAINTS), p=shares / shares.sum()))][0]
        red, green, blue = (np.array(faded) * rng.uniform(0.85, 1.1)).tolist()
        colour, metal = (red, green, blue), 0.0
    shape = sample_shape(kind, rng)
    mesh = motorcycle_mesh(shape) if kind == "motorcycle" else body_mesh(shape)
    return _Body(shape.vehicle_class, shape, mesh, _body_size(mesh), colour, metal)


def _with_outside_parts(mesh: Mesh, shape: Shape) -> Mesh:
    parts = outside_parts(shape)
    return replace(join([mesh, *parts]), extra=sum(len(part.triangles) for part in parts))


def _body_size(mesh: Mesh) -> NDArray[np.float64]:
    return np.asarray(np.ptp(mesh.vertices[mesh.body_vertices], axis=0))


def _shares() -> NDArray[np.float64]:
    shares = np.array([share for _, _, share in _PAINTS])
    return np.asarray(shares / shares.sum())
