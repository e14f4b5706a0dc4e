"""Body types: proportions and sizes of real vehicles, and how each varies."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labelgen.labels import VehicleClass

__all__ = ["BODY_TYPES", "Shape", "mean_shape", "sample_shape"]


@dataclass(frozen=True)
class Shape:
    """Proportions of a vehicle. Lengths in metres; `d` counts from the front bumper backwards.

    Args:
        kind: name of the body type.
        length, width, height: outer size without mirrors.
        clearance: height of the body's lower edge.
        nose: height of the bonnet's front edge.
        cowl: (d, z) where the windscreen begins.
        roof_front, roof_rear: (d, z) ends of the roof.
        rear_window: (d, z) where the rear window ends.
        tail: height of the rear edge above the bumper.
        belt: height of the side windows' lower edge.
        tumble: how far the windows lean inwards, m per m.
        corner: how much narrower the front end is, share of the width.
        axles: d of each axle.
        wheel: wheel radius.
        doors: number of side windows.
        vehicle_class: class in labels.
        share: how common it is in traffic.
        cargo: (d, clearance, height) of a box body that begins at d; None without one.
        bed: (d, depth) of a pickup's bed; None without one.
    """

    kind: str
    length: float
    width: float
    height: float
    clearance: float
    nose: float
    cowl: tuple[float, float]
    roof_front: tuple[float, float]
    roof_rear: tuple[float, float]
    rear_window: tuple[float, float]
    tail: float
    belt: float
    tumble: float
    corner: float
    axles: tuple[float, ...]
    wheel: float
    doors: int
    vehicle_class: VehicleClass
    share: float
    cargo: tuple[float, float, float] | None = None
    bed: tuple[float, float] | None = None


_CAR, _TRUCK, _BUS = VehicleClass.CAR, VehicleClass.TRUCK, VehicleClass.BUS
_CYCLE = VehicleClass.MOTORCYCLE

BODY_TYPES: dict[str, Shape] = {
    shape.kind: shape
    for shape in (
        Shape("supermini", 3.65, 1.66, 1.50, 0.19, 0.77, (0.80, 0.98), (1.50, 1.43), (2.95, 1.44), (3.48, 0.98), 0.88,
              0.93, 0.30, 0.12, (0.70, 3.08), 0.29, 2, _CAR, 0.10),
        Shape("hatchback", 4.20, 1.78, 1.47, 0.18, 0.76, (1.02, 0.97), (1.82, 1.41), (3.30, 1.42), (3.98, 0.98), 0.90,
              0.92, 0.34, 0.12, (0.84, 3.46), 0.31, 2, _CAR, 0.24),
        Shape("saloon", 4.70, 1.82, 1.45, 0.17, 0.74, (1.20, 0.95), (2.02, 1.39), (3.10, 1.41), (3.95, 1.03), 0.98,
              0.91, 0.36, 0.11, (0.90, 3.66), 0.32, 2, _CAR, 0.17),
        Shape("estate", 4.70, 1.81, 1.49, 0.17, 0.75, (1.15, 0.96), (1.98, 1.41), (4.10, 1.43), (4.56, 0.98), 0.90,
              0.92, 0.32, 0.11, (0.90, 3.64), 0.32, 3, _CAR, 0.16),
        Shape("suv", 4.50, 1.86, 1.68, 0.24, 0.95, (1.10, 1.12), (1.85, 1.60), (3.75, 1.62), (4.32, 1.12), 1.02,
              1.07, 0.28, 0.10, (0.88, 3.56), 0.36, 3, _CAR, 0.14),
        Shape("minivan", 4.45, 1.82, 1.66, 0.19, 0.84, (0.82, 1.05), (1.80, 1.58), (3.85, 1.62), (4.32, 1.02), 0.92,
              0.98, 0.25, 0.12, (0.88, 3.60), 0.32, 3, _CAR, 0.04),
        Shape("van", 5.40, 2.00, 2.40, 0.24, 1.05, (0.75, 1.22), (1.50, 2.15), (5.30, 2.38), (5.37, 1.35), 0.60,
              1.18, 0.10, 0.10, (0.98, 4.35), 0.34, 1, _CAR, 0.06),
        Shape("pickup", 5.25, 1.86, 1.80, 0.28, 0.95, (1.30, 1.16), (2.05, 1.72), (3.20, 1.74), (3.45, 1.16), 1.10,
              1.12, 0.24, 0.09, (0.95, 4.10), 0.38, 2, _CAR, 0.02, bed=(3.50, 0.45)),
        Shape("lorry", 8.20, 2.45, 3.50, 0.32, 1.05, (0.10, 1.55), (0.45, 2.75), (1.95, 2.85), (2.05, 1.60), 1.40,
              1.60, 0.06, 0.06, (1.30, 5.90), 0.48, 1, _TRUCK, 0.04, cargo=(2.20, 1.00, 3.50)),
        Shape("bus", 11.8, 2.55, 3.10, 0.30, 0.80, (0.06, 1.05), (0.35, 2.95), (11.65, 3.05), (11.74, 1.60), 0.90,
              1.20, 0.04, 0.06, (2.70, 8.60), 0.48, 8, _BUS, 0.02),
        Shape("articulated", 15.5, 2.50, 3.95, 0.34, 1.10, (0.08, 1.75), (0.50, 3.40), (2.10, 3.60), (2.20, 1.80), 1.40,
              1.80, 0.06, 0.06, (1.40, 4.70, 11.9, 13.2), 0.50, 1, _TRUCK, 0.01, cargo=(2.60, 1.10, 3.95)),
        # Of a motorcycle only size, axles and wheels count; `motorcycle` makes the rest.
        Shape("motorcycle", 2.15, 0.76, 1.66, 0.15, 0.80, (0.5, 0.9), (0.8, 1.5), (1.2, 1.5), (1.6, 0.9), 0.8,
              0.8, 0.0, 0.0, (0.32, 1.80), 0.32, 1, _CYCLE, 0.05),
    )
}  # fmt: skip


def _stretched(point: tuple[float, float], along: float, up: float) -> tuple[float, float]:
    return point[0] * along, point[1] * up


# Bounds of what varies evenly about a type's form, as factors: the nose's height, how far windows lean inwards, how
# round the corners are in plan, the wheels.
_NOSES, _TUMBLES, _CORNERS, _WHEELS = (0.94, 1.08), (0.95, 1.4), (0.9, 1.7), (0.96, 1.05)


def mean_shape(kind: str) -> Shape:
    """The mean of a body type's vehicles, which lean and round more than its plainest form."""
    base = BODY_TYPES[kind]
    nose, tumble, corner, wheel = (sum(bounds) / 2 for bounds in (_NOSES, _TUMBLES, _CORNERS, _WHEELS))
    return replace(
        base,
        nose=base.nose * nose,
        tumble=base.tumble * tumble,
        corner=base.corner * corner,
        wheel=base.wheel * wheel,
    )


def sample_shape(kind: str, rng: np.random.Generator) -> Shape:
    """One vehicle of a body type, with proportions that vary as real models do."""
    base = BODY_TYPES[kind]
    along, wide, up = rng.normal(1, [0.035, 0.018, 0.018]).clip([0.92, 0.96, 0.96], [1.08, 1.04, 1.04])
    if kind == "bus":
        along = rng.uniform(0.85, 1.02)
    lean = rng.uniform(-0.12, 0.15)
    cowl = _stretched(base.cowl, along, up)
    roof_front = _stretched(base.roof_front, along, up)
    return replace(
        base,
        length=base.length * along,
        width=base.width * wide,
        height=base.height * up,
        nose=base.nose * up * rng.uniform(*_NOSES),
        cowl=cowl,
        roof_front=(roof_front[0] + lean * (roof_front[0] - cowl[0]), roof_front[1]),
        roof_rear=_stretched(base.roof_rear, along, up),
        rear_window=_stretched(base.rear_window, along, up),
        tail=base.tail * up,
        belt=base.belt * up,
        tumble=base.tumble * rng.uniform(*_TUMBLES),
        corner=base.corner * rng.uniform(*_CORNERS),
        axles=tuple(d * along for d in base.axles),
        wheel=base.wheel * rng.uniform(*_WHEELS),
        cargo=None if base.cargo is None else (base.cargo[0] * along, base.cargo[1], base.cargo[2] * up),
        bed=None if base.bed is None else (base.bed[0] * along, base.bed[1]),
    )
