"""What lorries carry and how buses are panelled."""

from __future__ import annotations

import numpy as np

from labelgen.synth.fittings import BLACK, TRIM, Style, plate
from labelgen.synth.mesh import Chart
from labelgen.synth.raster import GLASS, LAMP, LIT, MATTE, PAINT
from labelgen.synth.shapes import Shape
from labelgen.synth.skin import Colour, Skin, dim

__all__ = ["draw_bus", "draw_cargo"]

_STEEL: Colour = (0.26, 0.26, 0.27)


def _ink(rng: np.random.Generator) -> Colour:
    """Letters and bands: some colour, faded by sun and dust."""
    bright = rng.uniform(0.01, 0.6, 3) ** 1.3
    red, green, blue = (0.6 * bright + 0.4 * bright.mean()).tolist()
    return red, green, blue


def draw_cargo(
    skin: Skin, shape: Shape, colour: Colour, style: Style, rng: np.random.Generator, *, lamps: bool
) -> None:
    """A box body or curtain-sided one: panels or curtains, lettering, doors, lamps, what hangs below."""
    assert shape.cargo is not None
    start, low, high = shape.cargo
    half, length = shape.width / 2, shape.length
    seam = dim(colour, 0.5)
    skin.rectangle(Chart.SIDE, (start - 0.05, low - 0.05), (length + 0.1, high + 0.1), colour, PAINT)
    skin.rectangle(Chart.TOP, (start - 0.05, -half - 0.3), (length + 0.1, half + 0.3), dim(colour, 0.9), MATTE)
    skin.rectangle(Chart.REAR, (-half - 0.2, low - 0.05), (half + 0.2, high + 0.1), colour, PAINT)
    skin.rectangle(Chart.FRONT, (-half - 0.2, shape.roof_rear[1] + 0.1), (half + 0.2, high + 0.1), colour, PAINT)
    curtain = rng.random() < 0.45
    gap = rng.uniform(0.35, 0.7) if curtain else rng.uniform(0.8, 2.0)
    for d in np.arange(start + gap, length, gap).tolist():
        if curtain:
            skin.emboss(Chart.SIDE, [(d, low), (d + 0.12, low), (d + 0.12, high), (d, high)], 0.03, soft=True)
            skin.rectangle(Chart.SIDE, (d, low - 0.02), (d + 0.05, low + 0.14), (0.1, 0.1, 0.1), MATTE)
        else:
            skin.groove(Chart.SIDE, [(d, low), (d, high)])
            skin.line(Chart.SIDE, [(d, low), (d, high)], dim(colour, 0.8), PAINT)
    _lettering(skin, shape, start, rng)
    for edge in (low + 0.04, high - 0.04):
        skin.line(Chart.SIDE, [(start, edge), (length, edge)], _STEEL, MATTE, 0.06)
        skin.line(Chart.REAR, [(-half, edge), (half, edge)], _STEEL, MATTE, 0.08)
    _back_doors(skin, half, low, high, seam)
    red: Colour = (0.75, 0.03, 0.02) if lamps else (0.34, 0.008, 0.008)
    for side in (-1, 1):
        skin.rectangle(Chart.REAR, (side * 0.70, 0.46), (side * 1.14, 0.62), BLACK, MATTE)
        skin.rectangle(Chart.REAR, (side * 0.74, 0.49), (side * 0.98, 0.59), red, LIT if lamps else LAMP)
        skin.rectangle(Chart.REAR, (side * 0.99, 0.49), (side * 1.11, 0.59), (0.5, 0.2, 0.02), LAMP)
    if rng.random() < 0.6:  # reflecting strips along the edges
        for k, d in enumerate(np.arange(start, length, 0.3).tolist()):
            if k % 2:
                skin.rectangle(Chart.SIDE, (d, low + 0.09), (d + 0.25, low + 0.13), (0.6, 0.25, 0.02), PAINT)
        for z0, z1 in ((low + 0.1, low + 0.16), (high - 0.16, high - 0.1)):
            skin.rectangle(Chart.REAR, (-half + 0.1, z0), (half - 0.1, z1), (0.5, 0.04, 0.03), PAINT)
    plate(skin, Chart.REAR, (0, 0.55), style.plate, rng)


def _lettering(skin: Skin, shape: Shape, start: float, rng: np.random.Generator) -> None:
    """A company's name as bars of ink, on the sides and the back."""
    assert shape.cargo is not None
    if rng.random() < 0.25:
        return
    _, low, high = shape.cargo
    tall, long = high - low, shape.length - start
    ink, left = _ink(rng), start + rng.uniform(0.08, 0.3) * long
    if rng.random() < 0.4:
        band = (start, low + 0.1), (shape.length, low + rng.uniform(0.25, 0.5) * tall)
        skin.rectangle(Chart.SIDE, *band, _ink(rng), PAINT)
    base, size = low + rng.uniform(0.4, 0.6) * tall, rng.uniform(0.12, 0.3) * tall
    for k in range(int(rng.integers(4, 11))):
        wide = rng.uniform(0.3, 0.8) * size
        d = left + 0.9 * size * k
        if d + wide < shape.length - 0.3:
            skin.rectangle(Chart.SIDE, (d, base), (d + wide, base + size), ink, PAINT)
            skin.rectangle(
                Chart.SIDE, (d + 0.3 * wide, base + 0.3 * size), (d + 0.6 * wide, base + 0.6 * size), dim(ink, 2), PAINT
            )
    if rng.random() < 0.6:
        at = low + rng.uniform(0.5, 0.7) * tall
        skin.rectangle(Chart.REAR, (-0.8, at), (0.8, at + 0.35), ink, PAINT)


def _back_doors(skin: Skin, half: float, low: float, high: float, seam: Colour) -> None:
    skin.line(Chart.REAR, [(0, low), (0, high)], seam, PAINT, 0.02)
    skin.groove(Chart.REAR, [(0, low), (0, high)])
    for y in (-0.65, -0.25, 0.25, 0.65):
        skin.line(Chart.REAR, [(y * half, low), (y * half, high)], _STEEL, MATTE, 0.03)
        skin.rectangle(Chart.REAR, (y * half - 0.04, low + 0.5), (y * half + 0.10, low + 0.56), TRIM, MATTE)
    for side in (-1, 1):
        for z in np.linspace(low + 0.2, high - 0.2, 4).tolist():
            skin.rectangle(Chart.REAR, (side * (half - 0.12), z), (side * half, z + 0.06), _STEEL, MATTE)


def draw_bus(skin: Skin, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator) -> None:
    """Doors, displays, stripes, panels, what stands on the roof, an advertisement."""
    half, foot = shape.width / 2, shape.clearance
    second = _ink(rng)
    if rng.random() < 0.6:
        skin.rectangle(Chart.SIDE, (0, foot + 0.1), (shape.length, foot + rng.uniform(0.3, 0.6)), second, PAINT)
        skin.rectangle(Chart.REAR, (-half, foot + 0.1), (half, foot + 0.5), second, PAINT)
    if rng.random() < 0.5:
        low = (rng.uniform(3, 5), foot + 0.25)
        skin.rectangle(Chart.SIDE, low, (low[0] + rng.uniform(2, 4), shape.belt - 0.05), _ink(rng), PAINT)
        skin.rectangle(Chart.REAR, (-0.8 * half, 0.9), (0.8 * half, 1.5), _ink(rng), PAINT)
    for axle in shape.axles:
        skin.circle(Chart.SIDE, (axle, shape.wheel), 1.13 * shape.wheel, (0.005, 0.005, 0.005), MATTE)
    for d in np.arange(1.2, shape.length - 0.5, 1.25).tolist():
        skin.groove(Chart.SIDE, [(d, foot), (d, shape.belt)])
        skin.line(Chart.SIDE, [(d, foot + 0.1), (d, shape.belt)], dim(paint, 0.6), PAINT)
    for d in (0.35, 5.6):
        skin.rectangle(Chart.SIDE, (d, foot + 0.12), (d + 1.15, shape.height - 0.45), BLACK, PAINT)
        skin.rectangle(Chart.SIDE, (d + 0.06, foot + 0.2), (d + 0.54, shape.height - 0.52), style.glass, GLASS)
        skin.rectangle(Chart.SIDE, (d + 0.62, foot + 0.2), (d + 1.09, shape.height - 0.52), style.glass, GLASS)
    for chart in (Chart.FRONT, Chart.REAR):
        wide = 0.75 if chart is Chart.FRONT else 0.4
        z = shape.height - 0.42
        skin.rectangle(chart, (-wide - 0.06, z), (wide + 0.06, z + 0.26), BLACK, GLASS)
        for k in range(8):
            left = -wide + 0.1 + k * (2 * wide - 0.2) / 8
            skin.rectangle(chart, (left, z + 0.06), (left + 0.6 * wide / 8, z + 0.2), (0.75, 0.33, 0.03), LIT)
    skin.rectangle(Chart.REAR, (-0.7 * half, 0.55), (0.7 * half, 0.85), dim(paint, 0.5), MATTE)
    for z in np.arange(0.58, 0.85, 0.05).tolist():
        skin.line(Chart.REAR, [(-0.65 * half, z), (0.65 * half, z)], BLACK, MATTE)
    for d in np.arange(rng.uniform(1.5, 3), shape.length - 2, rng.uniform(2.2, 4.0)).tolist():
        size = rng.uniform([0.7, 0.4], [2.0, 0.85])
        ring = [(d, -size[1]), (d + size[0], -size[1]), (d + size[0], size[1]), (d, size[1])]
        skin.polygon(Chart.TOP, ring, dim(paint, rng.uniform(0.5, 1.0)), MATTE)
        skin.emboss(Chart.TOP, ring, 0.03)
        for k in range(4):
            at = d + (k + 0.5) * size[0] / 4
            skin.line(Chart.TOP, [(at, -0.7 * size[1]), (at, 0.7 * size[1])], BLACK, MATTE, 0.03)
