"""Mesh and texture of a motorcycle with its rider."""

from __future__ import annotations

import numpy as np

from labelgen.synth.shading.materials import CHROME, GLASS, LAMP, LIT, MATTE, PAINT, PLATE
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.mesh import Chart, Mesh, box_mesh, join, tube_mesh, wheel_mesh
from labelgen.synth.vehicle.texture import Colour, Texture

__all__ = ["draw_motorcycle", "motorcycle_mesh"]

_DARK: Colour = (0.012, 0.012, 0.013)


def motorcycle_mesh(shape: Shape) -> Mesh:
    """Return a mesh whose bounding cuboid stands on z = 0, centred at x = y = 0; lengths follow the shape's."""
    k, w, h = shape.length / 2.15, shape.width / 0.76, shape.height / 1.66
    front, rear = shape.length / 2 - shape.axles[0], shape.length / 2 - shape.axles[1]
    parts = [wheel_mesh(x, 0.06, shape.wheel, 0.12, side) for x in (front, rear) for side in (1, -1)]
    low, top = shape.wheel, 0.82 * h
    parts.append(tube_mesh([(front, 0, low), (front - 0.12, 0, 0.6), (front - 0.30, 0, 1.02 * h)], (0.07, 0.07, 0.05)))
    body = [(0.55, 0.62), (0.35, 0.80), (0.0, 0.74), (-0.45, 0.72), (-0.95, 0.82)]
    parts.append(tube_mesh([(x * k, 0, z * h) for x, z in body], (0.14, 0.19, 0.16, 0.13, 0.05), sides=12))
    parts.append(tube_mesh([(0.30 * k, 0, 0.40), (0, 0, 0.42), (-0.3 * k, 0, 0.40)], (0.14, 0.20, 0.12)))
    bar = 0.38 * w
    parts.append(tube_mesh([(0.36 * k, -bar, 1.0 * h), (0.42 * k, 0, 0.98 * h), (0.36 * k, bar, 1.0 * h)], (0.03,) * 3))
    # The rider: trunk, helmet, arms to the bar, legs beside the engine.
    hip, neck = (-0.35 * k, 0.0, top), (0.0, 0.0, 1.36 * h)
    chest = tuple(0.5 * (a + b) for a, b in zip(hip, neck, strict=True))
    trunk = tube_mesh([hip, chest, neck], (0.17, 0.21, 0.10), sides=12)
    parts.append(Mesh(trunk.vertices * [1, 1.15, 1], trunk.triangles, trunk.normals, trunk.charts))
    head = [(0.06 * k + dx, 0.0, z * h) for dx, z in ((0, 1.36), (0.02, 1.42), (0.03, 1.52), (0.02, 1.61), (0, 1.66))]
    parts.append(tube_mesh(head, (0.06, 0.12, 0.14, 0.11, 0.02), chart=None))
    for side in (-1, 1):
        hand = (0.35 * k, side * 0.33 * w, 1.0 * h)
        arm = [(-0.02 * k, side * 0.2, 1.26 * h), (0.12 * k, side * 0.34 * w, 1.08 * h), hand]
        parts.append(tube_mesh(arm, (0.07, 0.06, 0.05), sides=8))
        leg = [(-0.3 * k, side * 0.13, top), (0.08 * k, side * 0.26 * w, 0.72 * h), (-0.18 * k, side * 0.24 * w, 0.32)]
        parts.append(tube_mesh(leg, (0.11, 0.085, 0.06), sides=8))
    parts.append(box_mesh((-1.02 * k, -0.09, 0.55), (-0.98 * k, 0.09, 0.75), chart=None))
    mesh = join(parts)
    low_corner, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    shift = np.array([(low_corner[0] + high[0]) / 2, (low_corner[1] + high[1]) / 2, low_corner[2]])
    return Mesh(mesh.vertices - shift, mesh.triangles, mesh.normals, mesh.charts)


def _clothes(rng: np.random.Generator) -> Colour:
    """Sample the colour of clothes: mostly black and grey, some navy, rarely another muted colour."""
    level, kind = float(np.exp(rng.uniform(np.log(0.010), np.log(0.09)))), rng.random()
    if kind < 0.72:
        return level, level, level * 1.05
    if kind < 0.93:
        return 0.65 * level, 0.8 * level, 1.15 * level
    red, green, blue = (level + 0.22 * (rng.uniform(0.02, 0.3, 3) - level)).tolist()
    return red, green, blue


def _helmet(rng: np.random.Generator) -> Colour:
    kind, bright = rng.random(), rng.uniform(0.8, 1.15)
    grey = (0.012, 0.10, 0.50)[0 if kind < 0.5 else 1 if kind < 0.7 else 2] * bright
    if kind > 0.93:
        return 0.14 * bright, 0.03, 0.03
    return grey, grey, 1.03 * grey


def draw_motorcycle(texture: Texture, shape: Shape, paint: Colour, rng: np.random.Generator, *, lamps: bool) -> None:
    """Paint motorcycle, rider, lamps and plate on an empty texture; lamps are lit when `lamps`."""
    jacket, helmet = _clothes(rng), _helmet(rng)
    legs: Colour = ((0.012, 0.012, 0.014), (0.03, 0.045, 0.10), (0.10, 0.09, 0.07))[int(rng.integers(3))]
    h = shape.height / 1.66
    for chart in (Chart.SIDE, Chart.TOP, Chart.FRONT, Chart.REAR):
        texture.fill(chart, jacket, MATTE)
    texture.fill(Chart.WHEEL, _DARK, MATTE)
    texture.fill(Chart.DARK, _DARK, MATTE)
    length, half = shape.length, shape.width / 2
    texture.rectangle(Chart.SIDE, (0, 0), (length, 0.80 * h), _DARK, MATTE)
    texture.rectangle(Chart.SIDE, (0.45, 0.60 * h), (1.25, 0.97 * h), paint, PAINT)
    texture.rectangle(Chart.SIDE, (1.45, 0.70 * h), (length, 0.90 * h), paint, PAINT)
    texture.rectangle(Chart.SIDE, (0.75, 0.20), (1.45, 0.74 * h), legs, MATTE)
    texture.rectangle(Chart.SIDE, (0.8, 0.26), (1.5, 0.36), (0.4, 0.4, 0.4), CHROME)
    texture.rectangle(Chart.SIDE, (0.6, 1.37 * h), (1.5, 1.7 * h), helmet, PAINT)
    texture.rectangle(Chart.SIDE, (0.8, 1.44 * h), (0.98, 1.54 * h), _DARK, GLASS)
    texture.rectangle(Chart.TOP, (0.0, -half), (0.62, half), paint, PAINT)
    texture.rectangle(Chart.TOP, (1.5, -half), (length, half), _DARK, MATTE)
    texture.circle(Chart.TOP, (length / 2 - 0.09, 0), 0.15, helmet, PAINT)
    for chart in (Chart.FRONT, Chart.REAR):
        texture.rectangle(chart, (-half, 0), (half, 0.85 * h), _DARK, MATTE)
        texture.rectangle(chart, (-half, 0.2), (-0.12, 0.74 * h), legs, MATTE)
        texture.rectangle(chart, (0.12, 0.2), (half, 0.74 * h), legs, MATTE)
        texture.rectangle(chart, (-0.18, 0.6 * h), (0.18, 0.98 * h), paint, PAINT)
        texture.rectangle(chart, (-0.3, 1.36 * h), (0.3, 1.7 * h), helmet, PAINT)
    texture.rectangle(Chart.FRONT, (-0.1, 1.43 * h), (0.1, 1.54 * h), _DARK, GLASS)
    texture.circle(Chart.FRONT, (0, 0.80 * h), 0.10, (0.9, 0.88, 0.8), LIT if lamps else LAMP)
    texture.rectangle(Chart.REAR, (-0.08, 0.76 * h), (0.08, 0.83 * h), (0.17, 0.014, 0.016), LIT if lamps else LAMP)
    texture.rectangle(Chart.REAR, (-0.1, 0.56), (0.1, 0.74), (0.55, 0.55, 0.52), PLATE)
    for axle in shape.axles:
        texture.circle(Chart.WHEEL, (axle, shape.wheel), 0.7 * shape.wheel, (0.1, 0.1, 0.1), CHROME)
        texture.circle(Chart.WHEEL, (axle, shape.wheel), 0.6 * shape.wheel, _DARK, MATTE)
