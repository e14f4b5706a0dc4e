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
        length, width, height: outer size without mirrors and `roof_unit`.
        clearance: height of the body's lower edge.
        nose: height of the bonnet's front edge.
        cowl: (d, z) where the windscreen begins.
        roof_front, roof_rear: (d, z) ends of the roof.
        rear_window: (d, z) where the rear window ends.
        tail: height of the rear edge above the bumper.
        belt: height of the side windows' lower edge.
        tumble: how far the windows lean inwards, m per m.
        corner: how much narrower the front end is, share of the width.
        round_nose, round_tail: metres by which the sides of the front and the rear end stand behind their middles.
        axles: d of each axle.
        wheel: wheel radius.
        doors: number of side windows.
        vehicle_class: class in labels.
        share: how common it is in traffic.
        cargo: (d, clearance, height) of a box body that begins at d; None without one.
        bed: (d, depth) of a pickup's bed; None without one.
        aerial: d of the foot of a whip aerial on the roof; None without one.
        roof_unit: (d, length, width, height) of an air conditioner's housing on the roof; None without one.
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
    round_nose: float
    round_tail: float
    axles: tuple[float, ...]
    wheel: float
    doors: int
    vehicle_class: VehicleClass
    share: float
    cargo: tuple[float, float, float] | None = None
    bed: tuple[float, float] | None = None
    aerial: float | None = None
    roof_unit: tuple[float, float, float, float] | None = None


_CAR, _TRUCK, _BUS = VehicleClass.CAR, VehicleClass.TRUCK, VehicleClass.BUS
_CYCLE = VehicleClass.MOTORCYCLE

BODY_TYPES: dict[str, Shape] = {
    shape.kind: shape
    for shape in (
        Shape("supermini", 3.80, 1.69, 1.49, 0.18, 0.80, (0.76, 1.01), (1.56, 1.42), (3.05, 1.42), (3.62, 0.99), 0.88,
              0.93, 0.33, 0.08, 0.22, 0.14, (0.74, 3.20), 0.30, 2, _CAR, 0.12),
        Shape("hatchback", 4.24, 1.79, 1.47, 0.17, 0.79, (0.92, 1.00), (1.80, 1.41), (3.32, 1.41), (4.02, 0.99), 0.90,
              0.92, 0.37, 0.08, 0.24, 0.14, (0.85, 3.48), 0.32, 2, _CAR, 0.24),
        Shape("saloon", 4.70, 1.82, 1.45, 0.16, 0.77, (1.09, 0.99), (2.02, 1.39), (3.12, 1.40), (4.00, 1.04), 0.98,
              0.91, 0.39, 0.08, 0.25, 0.15, (0.90, 3.66), 0.33, 2, _CAR, 0.17),
        Shape("estate", 4.65, 1.81, 1.48, 0.16, 0.78, (1.05, 1.00), (1.95, 1.41), (4.02, 1.41), (4.50, 0.99), 0.90,
              0.92, 0.35, 0.08, 0.24, 0.13, (0.90, 3.62), 0.33, 3, _CAR, 0.15),
        Shape("suv", 4.46, 1.85, 1.66, 0.22, 0.96, (0.98, 1.14), (1.82, 1.58), (3.68, 1.60), (4.26, 1.12), 1.02,
              1.06, 0.33, 0.07, 0.22, 0.13, (0.88, 3.54), 0.36, 3, _CAR, 0.14),
        Shape("minivan", 4.40, 1.82, 1.66, 0.18, 0.86, (0.76, 1.07), (1.80, 1.58), (3.80, 1.61), (4.26, 1.03), 0.92,
              0.98, 0.27, 0.08, 0.22, 0.12, (0.88, 3.60), 0.33, 3, _CAR, 0.05),
        Shape("van", 5.40, 2.00, 2.40, 0.24, 1.03, (0.72, 1.24), (1.50, 2.13), (5.26, 2.36), (5.36, 1.35), 0.60,
              1.18, 0.10, 0.07, 0.18, 0.03, (0.98, 4.35), 0.34, 1, _CAR, 0.05),
        Shape("pickup", 5.25, 1.86, 1.80, 0.26, 0.97, (1.20, 1.16), (2.02, 1.72), (3.20, 1.74), (3.45, 1.16), 1.10,
              1.12, 0.24, 0.07, 0.18, 0.06, (0.95, 4.10), 0.38, 2, _CAR, 0.02, bed=(3.50, 0.45)),
        Shape("lorry", 8.20, 2.45, 3.50, 0.32, 1.05, (0.10, 1.55), (0.45, 2.75), (1.95, 2.85), (2.05, 1.60), 1.40,
              1.60, 0.06, 0.03, 0.12, 0.0, (1.30, 5.90), 0.48, 1, _TRUCK, 0.04, cargo=(2.20, 1.00, 3.50)),
        Shape("bus", 11.8, 2.55, 3.10, 0.30, 0.80, (0.06, 1.05), (0.35, 2.95), (11.65, 3.05), (11.74, 1.60), 0.90,
              1.20, 0.04, 0.03, 0.14, 0.05, (2.70, 8.60), 0.48, 8, _BUS, 0.02),
        Shape("articulated", 15.5, 2.50, 3.95, 0.34, 1.10, (0.08, 1.75), (0.50, 3.40), (2.10, 3.60), (2.20, 1.80), 1.40,
              1.80, 0.06, 0.03, 0.12, 0.0, (1.40, 4.70, 11.9, 13.2), 0.50, 1, _TRUCK, 0.01, cargo=(2.60, 1.10, 3.95)),
        # Of a motorcycle only size, axles and wheels count; the module `motorcycle` adds the rest.
        Shape("motorcycle", 2.15, 0.76, 1.66, 0.15, 0.80, (0.5, 0.9), (0.8, 1.5), (1.2, 1.5), (1.6, 0.9), 0.8,
              0.8, 0.0, 0.0, 0.0, 0.0, (0.32, 1.80), 0.32, 1, _CYCLE, 0.05),
    )
}  # fmt: skip


def _stretched(point: tuple[float, float], along: float, up: float) -> tuple[float, float]:
    return point[0] * along, point[1] * up


# Ranges of uniformly sampled factors: height of the nose, inward lean of windows, roundness of the corners and of the
# ends in plan, wheel radius.
_NOSES, _TUMBLES, _CORNERS, _ROUNDS, _WHEELS = (0.93, 1.07), (0.95, 1.4), (0.9, 1.6), (0.75, 1.35), (0.96, 1.05)
# Ranges of uniformly sampled offsets of cars, metres: windscreen, its rake, end of the rear window, drop of the roof.
_SCREENS, _RAKES, _TAILS, _DROPS = (-0.12, 0.14), (-0.10, 0.10), (-0.10, 0.10), (-0.04, 0.04)


def mean_shape(kind: str) -> Shape:
    """Return the mean shape of a body type's vehicles: the sampled factors are not centred at 1."""
    base = BODY_TYPES[kind]
    bounds = (_NOSES, _TUMBLES, _CORNERS, _ROUNDS, _WHEELS)
    nose, tumble, corner, rounded, wheel = (sum(pair) / 2 for pair in bounds)
    return replace(
        base,
        nose=base.nose * nose,
        tumble=base.tumble * tumble,
        corner=base.corner * corner,
        round_nose=base.round_nose * rounded,
        round_tail=base.round_tail * rounded,
        wheel=base.wheel * wheel,
    )


def sample_shape(kind: str, rng: np.random.Generator) -> Shape:
    """Sample the shape of one vehicle of a body type; proportions vary as between real models."""
    base = BODY_TYPES[kind]
    along, wide, up = rng.normal(1, [0.035, 0.018, 0.018]).clip([0.92, 0.96, 0.96], [1.08, 1.04, 1.04])
    if kind == "bus":
        along = rng.uniform(0.85, 1.02)
    car = base.vehicle_class is _CAR and base.bed is None and kind != "van"
    screen, rake, tail, drop = (rng.uniform(*pair) if car else 0.0 for pair in (_SCREENS, _RAKES, _TAILS, _DROPS))
    cowl, roof_front = (_stretched(point, along, up) for point in (base.cowl, base.roof_front))
    roof_rear, rear_window = (_stretched(point, along, up) for point in (base.roof_rear, base.rear_window))
    window = min(rear_window[0] + tail, base.length * along - 0.13)
    places = (None, roof_front[0] + screen + 0.15, roof_rear[0] + tail - 0.15)
    aerial = places[int(rng.choice(3, p=[0.84, 0.05, 0.11]))] if car else None
    roof_unit = None
    if kind == "bus" and rng.random() < 0.95:
        size = rng.uniform([2.0, 1.4, 0.14], [3.6, 1.95, 0.28]).tolist()
        roof_unit = (rng.uniform(0.2, 0.55) * base.length * along, size[0], size[1], size[2])
    return replace(
        base,
        length=base.length * along,
        width=base.width * wide,
        height=base.height * up,
        nose=base.nose * up * rng.uniform(*_NOSES),
        cowl=(cowl[0] + screen, cowl[1]),
        roof_front=(roof_front[0] + screen + rake, roof_front[1]),
        roof_rear=(roof_rear[0] + tail, roof_rear[1] + drop),
        rear_window=(window, rear_window[1]),
        tail=base.tail * up,
        belt=base.belt * up,
        tumble=base.tumble * rng.uniform(*_TUMBLES),
        corner=base.corner * rng.uniform(*_CORNERS),
        round_nose=base.round_nose * rng.uniform(*_ROUNDS),
        round_tail=base.round_tail * rng.uniform(*_ROUNDS),
        axles=tuple(d * along for d in base.axles),
        wheel=base.wheel * rng.uniform(*_WHEELS),
        cargo=None if base.cargo is None else (base.cargo[0] * along, base.cargo[1], base.cargo[2] * up),
        bed=None if base.bed is None else (base.bed[0] * along, base.bed[1]),
        aerial=aerial,
        roof_unit=roof_unit,
    )
