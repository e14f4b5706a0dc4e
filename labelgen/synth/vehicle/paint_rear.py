"""Paint rears of cars and vans: windows, lids and doors, bumpers; lamps from `tail_lamp_designs`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.materials import CHROME, GLASS, LAMP, LIT, MATTE, PAINT
from labelgen.synth.vehicle.body_mesh import cabin_edge, setback, shell_end
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.paint_interior import draw_behind_rear_window, screen_coordinates
from labelgen.synth.vehicle.parts import (
    BLACK,
    CHROME_TONE,
    SEAM,
    TRIM,
    Style,
    draw_plate,
    draw_reflector,
    draw_sky_reflection,
    draw_window,
    mirrored,
)
from labelgen.synth.vehicle.texture import Colour, Texture, dim, rounded

__all__ = ["draw_rear"]


def draw_rear(
    texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool
) -> None:
    """Paint rear window or doors, lid, lamps, bumper and plate."""
    half, seam = shape.width / 2, dim(paint, SEAM)
    braking = bool(rng.random() < 0.12)
    foot = shape.clearance + 0.09 + style.cladding
    van = shape.kind == "van"
    top, tall = (1.12, 0.34) if van else (shape.tail - 0.02, rng.uniform(0.19, 0.28))
    bumper_top = foot + (shape.tail - foot) * rng.uniform(0.34, 0.5) if not van else shape.clearance + 0.34
    _bumper(texture, shape, paint, style, (foot, bumper_top), rng)
    if van:
        _rear_doors(texture, shape, style, seam, rng)
    else:
        _lid(texture, shape, paint, bumper_top, top, rng)
        _rear_screen(texture, shape, style, braking, rng)
    _tail_lamps(texture, shape, style, top, tall, rng, lamps, braking)
    if van:
        texture.circle(Chart.REAR, (0.3, top), 0.035, CHROME_TONE, CHROME)
    else:
        badge = top - rng.uniform(0.1, 0.5) * tall
        size = rng.uniform(0.028, 0.042)
        texture.circle(Chart.REAR, (0, badge), size, dim(CHROME_TONE, rng.uniform(0.4, 0.9)), LAMP)
        texture.circle(Chart.REAR, (0, badge), 0.5 * size, dim(CHROME_TONE, 0.2), PAINT)
        if rng.random() < 0.7:
            _model_names(texture, half, top, tall, rng)
    high = style.plate_high and not van
    z = 0.5 * (bumper_top + top - tall) + 0.02 if high else 0.45 * foot + 0.55 * bumper_top
    hollow = [(-0.36, z + 0.09), (-0.31, z - 0.085), (0.31, z - 0.085), (0.36, z + 0.09)]
    if not style.dark_bumpers or high:
        texture.emboss(Chart.REAR, rounded(hollow, 0.08), -0.025, soft=True)
        texture.shadow(Chart.REAR, [hollow[0], hollow[3]], rng.uniform(0.25, 0.5), 0.05)
    if rng.random() < 0.5:
        tone = dim(CHROME_TONE, 0.8) if style.chrome or rng.random() < 0.5 else dim(paint, 0.5)
        texture.rectangle(Chart.REAR, (-0.34, z + 0.085), (0.34, z + 0.11), tone, LAMP)
    draw_plate(texture, Chart.REAR, (0, z), style.plate, rng)


def _bumper(
    texture: Texture, shape: Shape, paint: Colour, style: Style, heights: tuple[float, float], rng: np.random.Generator
) -> None:
    """Paint the bumper: its ledge, the unpainted part, reflectors and exhaust pipes."""
    half, (foot, top) = shape.width / 2, heights
    texture.rectangle(Chart.REAR, (-half, 0), (half, foot), TRIM, MATTE)
    if style.dark_bumpers:
        texture.rectangle(Chart.REAR, (-half, 0), (half, top), TRIM, MATTE)
    rise = rng.uniform(0.0, 0.07)
    edge = [(-half, top + rise), (-0.6 * half, top), (0.6 * half, top), (half, top + rise)]
    sheet = [*edge, (half, foot), (-half, foot)]
    if shape.kind != "van":
        texture.bow(Chart.REAR, sheet, (0.0, rng.uniform(1.6, 3.2)), (0.0, 0.06))
    texture.emboss(Chart.REAR, [*edge, (half, 0), (-half, 0)], 0.03, soft=True)
    texture.line(Chart.REAR, edge, dim(paint, 0.45), PAINT, 0.014)
    texture.shadow(Chart.REAR, edge, rng.uniform(0.25, 0.5), 0.05)
    texture.shadow(Chart.REAR, [(-half, foot), (half, foot)], 0.35, 0.08)
    dark = foot + rng.uniform(0.15, 0.5) * (top - foot)
    if rng.random() < 0.35:  # unpainted below the bumper's middle
        skirt = [(-0.80 * half, foot - 0.02), (0.80 * half, foot - 0.02), (0.62 * half, dark), (-0.62 * half, dark)]
        texture.polygon(Chart.REAR, rounded(skirt, 0.06), TRIM, MATTE)
    for side in (-1, 1):
        low, high = (side * 0.74 * half, dark - 0.01), (side * 0.93 * half, dark + 0.02)
        texture.rectangle(Chart.REAR, low, high, (0.085, 0.014, 0.015), LAMP)
    pipes = int(rng.integers(3))
    for side in (-1, 1)[:pipes]:
        ring = [(0.56, foot), (0.70, foot), (0.70, foot + 0.05), (0.56, foot + 0.05)]
        texture.polygon(Chart.REAR, mirrored([(y * half, z) for y, z in ring], side), dim(CHROME_TONE, 0.4), LAMP)


def _lid(texture: Texture, shape: Shape, paint: Colour, low: float, top: float, rng: np.random.Generator) -> None:
    """Paint boot lid or tailgate: its gaps, a crease, its curvature."""
    half = shape.width / 2
    gap = rng.uniform(0.68, 0.8) * half
    for side in (-1, 1):
        line = mirrored([(gap - 0.05, low), (gap, low + 0.06), (gap, top), (gap - 0.06, top + 0.3)], side)
        texture.line(Chart.REAR, line[:3], dim(paint, 0.5), PAINT)
        texture.groove(Chart.REAR, line, 0.005)
    crease = low + rng.uniform(0.35, 0.8) * (top - low)
    sheet = [(-half, low), (half, low), (half, top), (-half, top)]
    texture.bow(Chart.REAR, sheet, (0.0, rng.uniform(0.3, 1.0)), (0.0, rng.uniform(-0.10, 0.0)))
    above = [(-half, crease + 0.03), (0, crease), (half, crease + 0.03), (half, top + 0.3), (-half, top + 0.3)]
    texture.emboss(Chart.REAR, above, rng.uniform(0.012, 0.03), soft=True)
    texture.shadow(Chart.REAR, above[:3], rng.uniform(0.1, 0.3), 0.06)


def _model_names(texture: Texture, half: float, top: float, tall: float, rng: np.random.Generator) -> None:
    """Paint chrome letters on the lid, beside the badge."""
    z = top - rng.uniform(0.1, 0.9) * tall
    for side in (-1, 1) if rng.random() < 0.6 else (int(rng.choice([-1, 1])),):
        start, count = rng.uniform(0.22, 0.36) * half, int(rng.integers(2, 7))
        for k in range(count):
            y = side * (start + 0.034 * k)
            texture.rectangle(Chart.REAR, (y - 0.008, z - 0.011), (y + 0.008, z + 0.011), dim(CHROME_TONE, 0.4), LAMP)


def _rear_doors(texture: Texture, shape: Shape, style: Style, seam: Colour, rng: np.random.Generator) -> None:
    """Paint a van's rear doors: two side by side, or one that opens upwards."""
    high = shape.height
    kind = int(rng.choice(3, p=[0.35, 0.35, 0.3]))  # without windows, with two, one wide window
    if kind == 2:
        ring = [(-0.80, 1.30), (0.80, 1.30), (0.72, high - 0.38), (-0.72, high - 0.38)]
        inner = draw_window(texture, Chart.REAR, ring, style.rear_glass)
        placed = screen_coordinates([(0.76, 1.34), (-0.76, 1.34)], [(0.70, high - 0.42), (-0.70, high - 0.42)])
        draw_behind_rear_window(texture, Chart.REAR, placed, style.rear_glass, style.rear_clear, rng)
        draw_sky_reflection(texture, Chart.REAR, inner, rng, 0.4)
        texture.line(Chart.REAR, [(0.0, 1.32), (0.42, 1.42)], BLACK, MATTE, 0.02)
    else:
        middle = [(0, high - 0.12), (0, 0.45)]
        texture.line(Chart.REAR, middle, seam, PAINT, 0.014)
        texture.groove(Chart.REAR, middle)
    top = rng.uniform(high - 0.55, high - 0.36)
    for side in (-1, 1):
        for z0, z1 in ((1.30, top), (0.62, 1.05)):
            if kind == 2 and z0 > 1:
                continue
            ring = mirrored([(0.07, z0), (0.78, z0), (0.74, z1), (0.07, z1)], side)
            texture.emboss(Chart.REAR, rounded(ring, 0.08), -0.018, soft=True)
            if kind == 1 and z0 > 1:
                _door_pane(texture, ring, style, rng)
        edge = mirrored([(0.84, 0.5), (0.84, 2.05), (0.72, 2.2), (0, 2.22)], side)
        texture.groove(Chart.REAR, edge, 0.006)
        texture.shadow(Chart.REAR, edge, 0.25, 0.04)
        for z in (0.8, 1.7):
            texture.rectangle(Chart.REAR, (side * 0.84, z), (side * 0.90, z + 0.08), TRIM, MATTE)
    texture.rectangle(Chart.REAR, (0.04, 1.12), (0.2, 1.17), TRIM, MATTE)
    third = [(-0.2, high - 0.20), (0.2, high - 0.20), (0.2, high - 0.15), (-0.2, high - 0.15)]
    texture.polygon(Chart.REAR, third, (0.10, 0.011, 0.013), LAMP)
    for y, wide in ((0.45, 0.22), (-0.62, 0.2)):  # the maker's and the model's name
        for k in range(int(rng.integers(3, 7))):
            at = y + wide * k / 6
            texture.rectangle(Chart.REAR, (at, 1.2), (at + 0.02, 1.235), dim(CHROME_TONE, 0.4), LAMP)


def _door_pane(texture: Texture, ring: Any, style: Style, rng: np.random.Generator) -> None:
    """Paint a window in a van's door with film, a grille or the load behind it."""
    inner = draw_window(texture, Chart.REAR, ring, style.rear_glass, rim=0.92)
    low, high = inner.min(axis=0), inner.max(axis=0)
    behind = int(rng.choice(3, p=[0.4, 0.25, 0.35]))
    if behind == 1:
        for z in np.arange(low[1] + 0.05, high[1], 0.06).tolist():
            texture.line(Chart.REAR, [(low[0] + 0.04, z), (high[0] - 0.04, z)], (0.06, 0.06, 0.06), GLASS, 0.014)
    elif behind == 2:
        top = low[1] + rng.uniform(0.2, 0.7) * (high[1] - low[1])
        level = rng.uniform(0.03, 0.2)
        load = [(low[0] + 0.05, low[1] + 0.03), (high[0] - 0.1, low[1] + 0.03), (high[0] - 0.14, top)]
        texture.polygon(Chart.REAR, [*load, (low[0] + 0.08, top - 0.06)], (level, 0.9 * level, 0.75 * level), GLASS)
    texture.fade(Chart.REAR, inner, (0.22, 0.26, 0.27), (rng.uniform(0.2, 0.6), rng.uniform(0.02, 0.2)))


def _rear_screen(texture: Texture, shape: Shape, style: Style, braking: bool, rng: np.random.Generator) -> None:
    half = shape.width / 2
    low, high = shape.rear_window[1] + 0.03, shape.roof_rear[1] - 0.05
    y0, y1 = cabin_edge(shape, half, low) - 0.08, cabin_edge(shape, half, high) - 0.08
    ring = [(-y0, low), (y0, low), (y1, high), (-y1, high)]
    inner = draw_window(texture, Chart.REAR, ring, style.rear_glass, rim=0.93)
    placed = screen_coordinates(
        [(0.94 * y0, low + 0.03), (-0.94 * y0, low + 0.03)], [(y1, high - 0.03), (-y1, high - 0.03)]
    )
    draw_behind_rear_window(texture, Chart.REAR, placed, style.rear_glass, style.rear_clear, rng)
    draw_sky_reflection(texture, Chart.REAR, inner, rng, 0.12 + 0.2 * style.rear_clear)
    texture.line(Chart.REAR, ring[:2], BLACK, GLASS, 0.05)
    if shape.kind != "saloon" and rng.random() < 0.6:
        wiper = [(0.0, low + 0.01), (0.35, low + 0.09)]
        texture.line(Chart.REAR, wiper, BLACK, MATTE, 0.02)
    if rng.random() < 0.25:  # a paper or a sticker
        at = rng.uniform(-0.85, 0.75) * y0
        z, size = (low + 0.07, 0.05) if rng.random() < 0.5 else (high - 0.12, 0.04)
        texture.rectangle(Chart.REAR, (at, z - size), (at + 1.6 * size, z + size), (0.3, 0.31, 0.28), GLASS)
    third: tuple[Colour, int] = ((0.75, 0.08, 0.09), LIT) if braking else ((0.09, 0.010, 0.012), GLASS)
    texture.rectangle(Chart.REAR, (-0.16, high - 0.04), (0.16, high + 0.01), *third)


def _tail_lamps(
    texture: Texture, shape: Shape, style: Style, top: float, tall: float, rng: np.random.Generator, lamps: bool,
    braking: bool,
) -> None:  # fmt: skip
    """Paint tail lamps: red glass with clear and amber fields, reflectors and strips."""
    half, design = shape.width / 2, style.tail
    bright = rng.uniform(0.55, 1.15)
    unlit: Colour = (0.25 * bright, 0.013 * bright, 0.019 * bright)
    lit: Colour = (0.42, 0.034, 0.045) if braking else (0.30, 0.016, 0.02)
    core: Colour = (0.50, 0.06, 0.075) if braking else dim(lit, 1.5)
    # Unlit lamps have one colour, or fields of several.
    smoky = rng.random() < 0.25
    pale: Colour = dim((0.30, 0.25, 0.24), rng.uniform(0.5, 1.2)) if not smoky else dim(unlit, 0.5)
    orange: Colour = dim((0.26, 0.085, 0.012), rng.uniform(0.7, 1.2)) if rng.random() < 0.3 else dim(unlit, 0.6)
    mirrored_sky, deep = rng.uniform(0.0, 0.15), rng.uniform(0.4, 0.8)

    def at(points: Any, side: int) -> NDArray[np.float64]:
        return np.array(mirrored([(share * half, top - down * tall) for share, down in points], side))

    for side in (-1, 1):
        ring = at(design.outline, side)
        smooth, middle = rounded(ring, 0.13), ring.mean(axis=0)
        inner = middle + 0.92 * (smooth - middle)
        texture.polygon(Chart.REAR, smooth, dim(unlit, 0.2), LAMP)
        texture.polygon(Chart.REAR, inner, unlit, LAMP)
        texture.fade(Chart.REAR, inner, dim(unlit, 0.15), (0.0, deep))
        for field, colour in ((design.clear, pale), (design.amber, orange)):
            if field:
                texture.polygon(Chart.REAR, rounded(at(field, side), 0.08), colour, LAMP)
        for y, down, radius in design.bowls:
            centre = at([(y, down)], side)[0]
            draw_reflector(texture, Chart.REAR, centre, radius, (dim(unlit, 0.4), dim(unlit, 1.7), dim(unlit, 2.2)))
        for strip in design.strips:
            texture.line(Chart.REAR, at(strip, side), dim(unlit, 1.9), LAMP, 0.018)
        if lamps or braking:
            heart = middle + np.array([side * 0.05 * half, 0.12 * tall])
            glow = rounded(heart + 0.5 * (ring - middle), 0.1)
            texture.polygon(Chart.REAR, glow, lit, LIT)
            texture.polygon(Chart.REAR, heart + 0.6 * (glow - heart), core, LIT)
        texture.fade(Chart.REAR, inner, (0.24, 0.25, 0.27), (mirrored_sky, 0.0))
        spark = middle + np.array([side * 0.04 * half, 0.28 * tall])
        texture.circle(Chart.REAR, spark.tolist(), 0.018, (0.45, 0.24, 0.24), LAMP)
        # A dark gap separates it from the paint.
        texture.line(Chart.REAR, np.concatenate([smooth, smooth[:1]]), dim(unlit, 0.12), LAMP, 0.012)
        texture.bow(Chart.REAR, smooth, (0.8, 1.0), (0.0, 0.06))
    end = shell_end(shape)
    reach = end + float(setback(shape, end, 0.95 * half)) - 0.16
    above = top + max(-min(down for _, down in design.outline), 0.0) * tall
    below = top - max(down for _, down in design.outline) * tall
    side_view = [(end, below), (reach + 0.05, below + 0.15 * tall), (reach, above - 0.04), (end, above)]
    texture.polygon(Chart.SIDE, side_view, dim(unlit, 0.8), LAMP)
