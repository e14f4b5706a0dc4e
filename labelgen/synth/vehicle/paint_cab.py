"""Paint fronts of lorries and buses: tall screens over flat panels."""

from __future__ import annotations

import numpy as np

from labelgen.synth.shading.materials import GLASS, LAMP, LIT, MATTE, PAINT
from labelgen.synth.vehicle.body_mesh import cabin_edge
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.paint_interior import ScreenMap, draw_behind_windscreen, screen_coordinates
from labelgen.synth.vehicle.parts import (
    BLACK,
    CHROME_TONE,
    GLOW,
    TRIM,
    Style,
    draw_plate,
    draw_sky_reflection,
    draw_window,
    mirrored,
)
from labelgen.synth.vehicle.texture import Colour, Texture, dim, rounded

__all__ = ["draw_bus_front", "draw_cab_front"]


def draw_cab_front(
    texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool
) -> None:
    """Paint the front of a cab over its engine: bumper, lamps, grille, steps, air guides, screen and visor."""
    half, cowl = shape.width / 2, shape.cowl[1]
    bumper = rng.uniform(0.78, 0.90)
    tone = paint if rng.random() < 0.55 else dim((0.10, 0.10, 0.103), rng.uniform(0.4, 1.6))
    texture.rectangle(Chart.FRONT, (-half, 0), (half, bumper), tone, PAINT)
    texture.rectangle(Chart.FRONT, (-half, 0), (half, shape.clearance + 0.12), TRIM, MATTE)
    texture.emboss(Chart.FRONT, [(-half, 0), (half, 0), (half, bumper), (-half, bumper)], 0.03, soft=True)
    texture.shadow(Chart.FRONT, [(-half, bumper), (half, bumper)], 0.5, 0.07)
    hollow = rng.uniform(0.018, 0.07)
    dark: Colour = (hollow, hollow, 1.04 * hollow)
    wide, top = rng.uniform(0.62, 0.78) * half, cowl - rng.uniform(0.12, 0.22)
    foot = bumper + rng.uniform(0.03, 0.12)
    panel = rounded([(-0.94 * wide, foot), (0.94 * wide, foot), (wide, top), (-wide, top)], 0.06)
    if rng.random() < 0.55:
        texture.polygon(Chart.FRONT, panel, dark, MATTE)
    texture.emboss(Chart.FRONT, panel, -0.02)
    for z in np.arange(foot + 0.06, top - 0.1, rng.uniform(0.09, 0.16)).tolist():
        texture.line(Chart.FRONT, [(-0.9 * wide, z), (0.9 * wide, z)], dim(dark, rng.uniform(0.5, 2.2)), MATTE, 0.03)
        texture.groove(Chart.FRONT, [(-0.9 * wide, z), (0.9 * wide, z)], -0.008, 0.04)
    name = dim(CHROME_TONE, rng.uniform(0.4, 0.9))
    for k in range(int(rng.integers(3, 7))):
        y = 0.09 * (k - 2.5)
        texture.rectangle(Chart.FRONT, (y - 0.028, top - 0.11), (y + 0.028, top - 0.06), name, LAMP)
    texture.circle(Chart.FRONT, (0, foot + 0.4 * (top - foot)), 0.08, name, LAMP)
    texture.rectangle(Chart.FRONT, (-0.42 * half, 0.40), (0.42 * half, 0.60), dark, MATTE)
    slot = rounded(
        [(-0.52 * half, 0.66), (0.52 * half, 0.66), (0.56 * half, bumper - 0.05), (-0.56 * half, bumper - 0.05)]
    )
    texture.polygon(Chart.FRONT, slot, dim(dark, 0.6), MATTE)
    texture.emboss(Chart.FRONT, slot, -0.02)
    fog = rng.random() < 0.6
    low = rng.uniform(0.50, 0.58)
    for side in (-1, 1):
        _lamp(texture, [(0.60, low), (0.95, low + 0.02), (0.97, low + 0.24), (0.66, low + 0.20)], half, side, lamps)
        if fog:
            texture.circle(Chart.FRONT, (side * 0.55 * half, 0.48), 0.055, dim(CHROME_TONE, 0.9), LAMP)
        step = mirrored([(0.70, 0.30), (0.96, 0.30), (0.96, 0.44), (0.74, 0.44)], side)
        texture.polygon(Chart.FRONT, [(y * half, z) for y, z in step], TRIM, MATTE)
        guide = mirrored([(0.86, foot), (1.0, foot), (1.0, cowl), (0.88, cowl - 0.1)], side)
        texture.groove(Chart.FRONT, [(y * half, z) for y, z in [*guide, guide[0]]], 0.008)
    _screen(texture, shape, style, (cowl + 0.04, shape.roof_front[1] - 0.10), rng)
    if rng.random() < 0.65:  # a sun visor over the screen
        edge, z = 0.86 * half, shape.roof_front[1] - 0.10
        visor = [(-edge, z - 0.02), (edge, z - 0.02), (edge, z + 0.13), (-edge, z + 0.13)]
        texture.polygon(Chart.FRONT, visor, (0.02, 0.02, 0.021), GLASS)
        texture.emboss(Chart.FRONT, visor, 0.03, soft=True)
    draw_plate(texture, Chart.FRONT, (0, 0.50), style.plate, rng)


def draw_bus_front(
    texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool
) -> None:
    """Paint the front of a bus: a wide screen, lamps and plate in a low bumper."""
    half, bumper = shape.width / 2, rng.uniform(0.56, 0.66)
    texture.rectangle(Chart.FRONT, (-half, 0), (half, shape.clearance + 0.06), TRIM, MATTE)
    texture.emboss(Chart.FRONT, [(-half, 0), (half, 0), (half, bumper), (-half, bumper)], 0.03, soft=True)
    texture.shadow(Chart.FRONT, [(-half, bumper), (half, bumper)], 0.4, 0.05)
    texture.line(Chart.FRONT, [(-half, bumper), (half, bumper)], dim(paint, 0.5), PAINT, 0.02)
    foot = shape.cowl[1] - rng.uniform(0.0, 0.12)
    if rng.random() < 0.5:
        band = [(-0.7 * half, bumper + 0.03), (0.7 * half, bumper + 0.03), (0.8 * half, foot), (-0.8 * half, foot)]
        texture.polygon(Chart.FRONT, rounded(band, 0.06), (0.016, 0.016, 0.017), PAINT)
    for side in (-1, 1):
        points = [(0.60, bumper + 0.03), (0.93, bumper + 0.04), (0.95, bumper + 0.26), (0.74, bumper + 0.20)]
        _lamp(texture, points, half, side, lamps)
    texture.circle(Chart.FRONT, (0, bumper + 0.16), 0.07, dim(CHROME_TONE, 0.7), LAMP)
    _screen(texture, shape, style, (foot, shape.height - 0.42), rng)
    draw_plate(texture, Chart.FRONT, (0, 0.5), style.plate, rng)


def _screen(
    texture: Texture, shape: Shape, style: Style, heights: tuple[float, float], rng: np.random.Generator
) -> None:
    half, (low, high) = shape.width / 2, heights
    foot, head = (cabin_edge(shape, half, z) - 0.05 for z in heights)
    ring = [(-foot, low), (foot, low), (head, high), (-head, high)]
    inner = draw_window(texture, Chart.FRONT, ring, style.glass, rim=0.97)
    inside = screen_coordinates(
        [(0.95 * y, low + 0.04) for y in (-foot, foot)], [(0.95 * y, high) for y in (-head, head)]
    )
    # A cab has a wall behind its seats; a bus is long and dark inside.
    draw_behind_windscreen(texture, Chart.FRONT, inside, style.glass, 0.5 * style.clear, rng)
    _trim(texture, inside, rng)
    for at in (-0.5, 0.1):
        wiper = inside([(at + 0.5, 0.0), (at, 0.05 + 0.03 * rng.random())])
        texture.line(Chart.FRONT, wiper, BLACK, MATTE, 0.03)
    draw_sky_reflection(texture, Chart.FRONT, inner, rng, rng.uniform(0.5, 1.1))


def _trim(texture: Texture, inside: ScreenMap, rng: np.random.Generator) -> None:
    """Paint curtains, a visor folded down, cards and pennants behind the screen."""
    level = rng.uniform(0.02, 0.16)
    cloth: Colour = (level, level * rng.uniform(0.6, 1.0), level * rng.uniform(0.5, 1.0))
    for side in (-1, 1):
        fold = rng.uniform(0.80, 0.93)
        ring = [(side * y, up) for y, up in ((0.98, 0.1), (0.98, 0.98), (fold - 0.06, 0.98), (fold, 0.1))]
        texture.polygon(Chart.FRONT, inside(ring), cloth, GLASS)
    if rng.random() < 0.7:
        start, shade = rng.uniform(-0.9, 0.1), rng.uniform(0.02, 0.09)
        visor = [(start, 0.78), (start + 0.8, 0.78), (start + 0.8, 0.97), (start, 0.97)]
        texture.polygon(Chart.FRONT, inside(visor), (shade, shade, shade), GLASS)
    for _ in range(int(rng.integers(0, 4))):
        at, bright = rng.uniform(-0.85, 0.75), rng.uniform(0.08, 0.4)
        card = [(at, 0.03), (at + rng.uniform(0.06, 0.3), 0.03), (at + rng.uniform(0.06, 0.3), 0.1), (at, 0.1)]
        texture.polygon(
            Chart.FRONT, inside(card), (bright, bright * rng.uniform(0.5, 1), bright * rng.uniform(0.3, 1)), GLASS
        )


def _lamp(texture: Texture, points: list[tuple[float, float]], half: float, side: int, lamps: bool) -> None:
    """Paint a head lamp; corners are (share of the half-width, metres above the road)."""
    ring = np.array(mirrored([(y * half, z) for y, z in points], side))
    smooth, middle = rounded(ring, 0.1), ring.mean(axis=0)
    texture.polygon(Chart.FRONT, smooth, TRIM, LAMP)
    texture.polygon(Chart.FRONT, middle + 0.9 * (smooth - middle), (0.05, 0.05, 0.052), LAMP)
    outer = middle + 0.85 * (smooth - middle)
    texture.polygon(Chart.FRONT, outer[np.abs(outer[:, 0]) > np.abs(middle[0]) + 0.1], (0.22, 0.10, 0.03), LAMP)
    for along in (-0.09, 0.09):
        spot = (float(middle[0]) + side * along, float(middle[1]))
        texture.circle(Chart.FRONT, spot, 0.06, dim(CHROME_TONE, 0.8), LAMP)
        texture.circle(Chart.FRONT, spot, 0.04, dim(CHROME_TONE, 0.35), LAMP)
        if lamps and along > 0:
            texture.circle(Chart.FRONT, spot, 0.06, GLOW, LIT)
    texture.bow(Chart.FRONT, smooth, (0.6, 0.8), (0.0, 0.2))
