"""Texture of a car, van, bus or lorry: side panels, windows, doors and roof.

Fronts, rears and cargo are painted by modules of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from labelgen.synth.shading.materials import GLASS, LAMP, MATTE, PAINT
from labelgen.synth.vehicle.body_mesh import cabin_edge, face_edge, setback, shell_end, top_line
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.lettering import letter_van
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.paint_cab import draw_bus_front, draw_cab_front
from labelgen.synth.vehicle.paint_cargo import draw_bus, draw_bus_rear, draw_cargo
from labelgen.synth.vehicle.paint_front import draw_front
from labelgen.synth.vehicle.paint_interior import (
    ScreenMap,
    draw_behind_rear_window,
    draw_behind_windscreen,
    screen_coordinates,
)
from labelgen.synth.vehicle.paint_rear import draw_rear
from labelgen.synth.vehicle.parts import (
    BLACK,
    CHROME_TONE,
    SEAM,
    SILL,
    TRIM,
    Style,
    draw_dashboard_reflection,
    draw_sky_reflection,
    draw_wheels,
    draw_window,
    sample_style,
)
from labelgen.synth.vehicle.texture import Colour, Texture, dim

__all__ = ["draw_texture"]


def draw_texture(
    shape: Shape, extent_lwh: Sequence[float], paint: Colour, cargo: Colour, rng: np.random.Generator, *, lamps: bool,
    plates: str | None = None,
) -> Texture:  # fmt: skip
    """Paint the texture of one vehicle other than a motorcycle.

    Args:
        shape: its proportions.
        extent_lwh: metres, its mesh's bounding cuboid.
        paint, cargo: linear RGB.
        rng: gives style, plates, trim and wheels.
        lamps: whether its lamps are on.
        plates: one of `PLATES`; any when None.
    """
    texture = Texture(extent_lwh)
    style = sample_style(shape, rng, plates)
    for chart in (Chart.SIDE, Chart.TOP, Chart.FRONT, Chart.REAR):
        texture.fill(chart, paint, PAINT)
    texture.fill(Chart.DARK, (0.008, 0.008, 0.008), MATTE)
    heavy = shape.cargo is not None or shape.kind == "bus"
    texture.fill(Chart.MIRROR, dim(paint, 0.85) if rng.random() < (0.15 if heavy else 0.85) else TRIM, PAINT)
    windows_end = _draw_side(texture, shape, paint, style, rng)
    _draw_top(texture, shape, paint, style, rng)
    draw_wheels(texture, shape, rng)
    if shape.kind == "bus":
        draw_bus_front(texture, shape, paint, style, rng, lamps)
        draw_bus_rear(texture, shape, paint, style, rng, lamps=lamps)
        draw_bus(texture, shape, paint, style, rng)
    elif shape.cargo is not None:
        draw_cab_front(texture, shape, paint, style, rng, lamps)
        draw_cargo(texture, shape, cargo, style, rng, lamps=lamps)
    else:
        draw_front(texture, shape, paint, style, rng, lamps)
        draw_rear(texture, shape, paint, style, rng, lamps)
        if shape.kind == "van" and rng.random() < 0.45:
            letter_van(texture, shape, windows_end + 0.25, rng)
        dusty = rng.uniform(0.05, 0.25) if shape.kind in ("van", "pickup") else rng.uniform(0.0, 0.08)
        for chart in (Chart.SIDE, Chart.REAR, Chart.FRONT, Chart.TOP):
            texture.weather(chart, 0.0 if chart is Chart.TOP else dusty, 0.6 * dusty, rng)
    return texture


def _draw_side(texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator) -> float:
    """Paint panels, windows, doors and wheel arches; return d, metres, where the windows end."""
    end = shell_end(shape)
    waist = shape.belt - rng.uniform(0.16, 0.32)
    # A crease along the waist, bulges of the wings, hollows in the doors.
    texture.emboss(Chart.SIDE, [(0.5, 0), (end - 0.3, 0), (end - 0.3, waist + 0.06), (0.5, waist)], -0.022, soft=True)
    low_crease = shape.clearance + 0.22
    texture.emboss(
        Chart.SIDE, [(0.9, 0), (end - 0.9, 0), (end - 0.9, low_crease + 0.06), (0.9, low_crease)], 0.012, soft=True
    )
    texture.groove(Chart.SIDE, [(0.5, waist), (end - 0.2, waist + 0.06)], -0.006, 0.02)
    texture.bow(Chart.SIDE, [(0, 0), (end, 0), (end, shape.belt), (0, shape.belt)], (0.03, 0.5))
    texture.shadow(Chart.SIDE, [(0.2, shape.clearance), (end - 0.2, shape.clearance)], 0.65, 0.18)
    sill = shape.clearance + SILL + style.cladding
    texture.rectangle(Chart.SIDE, (0, 0), (shape.length, sill), TRIM, MATTE)
    if style.dark_bumpers:
        for low, high in ((0.0, 0.45), (end - 0.4, end)):
            texture.rectangle(Chart.SIDE, (low, 0), (high, shape.nose - 0.28), TRIM, MATTE)
    if rng.random() < 0.2:
        texture.rectangle(Chart.SIDE, (0.8, waist - 0.2), (end - 0.8, waist - 0.14), TRIM, MATTE)
    windows_end = 0.0 if shape.kind == "bus" else _side_windows(texture, shape, paint, style, rng)
    arch = 1.09 * shape.wheel
    for axle in shape.axles:
        grow = 1.35 if style.cladding > 0.1 else 1.12
        ring = _disc((axle, shape.wheel), arch * grow)
        if style.cladding > 0.1:
            texture.polygon(Chart.SIDE, _disc((axle, shape.wheel), arch * 1.18), TRIM, MATTE)
        texture.emboss(Chart.SIDE, ring, 0.014)
        texture.shadow(Chart.SIDE, _disc((axle, shape.wheel), arch), 0.6, 0.06)
        texture.circle(Chart.SIDE, (axle, shape.wheel), arch, (0.014, 0.014, 0.014), MATTE)
    for line in ([(0.52, shape.clearance + 0.1), (0.48, shape.nose - 0.26)], [(end - 0.42, sill), (end - 0.38, waist)]):
        texture.line(Chart.SIDE, line, dim(paint, SEAM), PAINT)
    if rng.random() < 0.3:
        texture.rectangle(Chart.SIDE, (0.62, waist + 0.02), (0.69, waist + 0.05), (0.30, 0.15, 0.03), LAMP)
    return windows_end


def _disc(centre: tuple[float, float], radius: float) -> Any:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    return np.stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], axis=1)


def _side_windows(texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator) -> float:
    """Paint side windows, pillars and doors; return d, metres, where the glass ends."""
    d, z = top_line(shape)
    sill, frame = shape.belt + 0.02, 0.075
    first = shape.cowl[0] + 0.20 * (shape.roof_front[0] - shape.cowl[0]) + 0.10
    last = shape.roof_rear[0] + 0.45 * (shape.rear_window[0] - shape.roof_rear[0])
    doors = shape.doors
    if shape.kind == "van":
        # A panel van, one with a second row, or a minibus.
        last = (shape.roof_front[0] + 0.75, shape.roof_front[0] + 1.9, last)[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
        doors = max(1, round((last - shape.roof_front[0]) / 1.1))
    elif shape.cargo is not None:
        last = shape.roof_rear[0] - 0.25
    inside = (z - frame > sill + 0.02) & (d > first) & (d < min(last, shape.rear_window[0]))
    if inside.sum() <= 4:
        return 0.0
    outline = np.concatenate([np.stack([d, z - frame], 1)[inside], [[d[inside][-1], sill], [d[inside][0], sill]]])
    if style.chrome:
        # As a bright tone: a reflecting line thinner than a pixel would be rendered in dashes.
        texture.line(Chart.SIDE, np.concatenate([outline, outline[:1]]), dim(CHROME_TONE, 0.55), LAMP, 0.03)
    texture.polygon(Chart.SIDE, outline, BLACK, GLASS)
    inner = outline + np.where(outline[:, 1:] > sill, [[0, -0.025]], [[0, 0.012]])
    texture.polygon(Chart.SIDE, inner, style.rear_glass, GLASS)
    low, high = float(d[inside][0]), float(d[inside][-1])
    pillars = np.linspace(low + 0.1, high, doors + 1)[1:-1].tolist()
    front_end = pillars[0] if pillars else high
    front = inner[(inner[:, 0] <= front_end)]
    if len(front) > 2:
        edge = [[front_end, float(front[-2 if len(front) > 2 else -1, 1])], [front_end, sill + 0.012]]
        texture.polygon(Chart.SIDE, np.concatenate([front[:-1], edge, front[-1:]]), style.glass, GLASS)
    within = [(low, sill + 0.012), (high, sill + 0.012), (high, sill + 0.09), (low, sill + 0.06)]
    texture.polygon(Chart.SIDE, within, dim(style.glass, 2.2), GLASS)
    seats = [(low, sill + 0.012), *((p + dp, sill + dz) for p in _seats(low, high) for dp, dz in _HEAD_REST)]
    texture.polygon(Chart.SIDE, [*seats, (high, sill + 0.012)], dim(style.glass, 0.5), GLASS)
    # Panes differ a little in angle, so each reflects another part of the roadside.
    for start, end in pairwise([low, *pillars, high]):
        ring = [(start, sill), (end, sill), (end, shape.height), (start, shape.height)]
        level = float(rng.uniform(0.06, 0.34))
        texture.fade(Chart.SIDE, ring, (0.85 * level, level, 1.05 * level), (rng.uniform(0.3, 0.6), 0.08))
    body_pillars = rng.random() < 0.5
    for p in pillars:
        tone = dim(paint, 0.9) if body_pillars else BLACK
        texture.rectangle(Chart.SIDE, (p - 0.065, sill), (p + 0.065, shape.height), tone, PAINT)
        texture.shadow(Chart.SIDE, [(p - 0.07, sill), (p - 0.07, shape.height)], 0.3, 0.03)
    texture.line(Chart.SIDE, [(low, sill), (high, sill)], (0.03, 0.03, 0.032), PAINT, 0.03)
    # The band of roof above the windows.
    band = np.concatenate([np.stack([d, z + 0.02], 1), np.stack([d, z - frame], 1)[::-1]])
    texture.polygon(Chart.SIDE, band, paint, PAINT)
    _doors(texture, shape, paint, (low, high), pillars, rng)
    return high


_HEAD_REST = ((-0.12, 0.03), (-0.10, 0.16), (-0.08, 0.24), (0.08, 0.24), (0.10, 0.16), (0.14, 0.03))


def _seats(low: float, high: float) -> list[float]:
    """Return d, metres, of the seats behind side windows."""
    return np.arange(low + 0.75, high - 0.15, 0.85).tolist()


def _doors(
    texture: Texture,
    shape: Shape,
    paint: Colour,
    span: tuple[float, float],
    pillars: list[float],
    rng: np.random.Generator,
) -> None:
    low, high = span
    sill, foot, seam = shape.belt + 0.02, shape.clearance + 0.16, dim(paint, SEAM)
    gaps = [low + 0.05, *pillars[:2], min(high, pillars[-1] + 1.0) if pillars else high]
    for k, p in enumerate(gaps):
        bend = -0.12 if k == len(gaps) - 1 and shape.kind != "van" else 0.0
        line = [(p, sill), (p, sill - 0.35), (p + bend, foot)]
        texture.line(Chart.SIDE, line, seam, PAINT, 0.012)
        texture.groove(Chart.SIDE, line)
        texture.shadow(Chart.SIDE, line, 0.15, 0.04)
    texture.line(Chart.SIDE, [(low, foot), (high, foot)], seam, PAINT, 0.012)
    texture.groove(Chart.SIDE, [(low, foot), (high, foot)])
    chrome = rng.random() < 0.1
    for p in [*pillars[:2], high - 0.1]:
        handle: tuple[Colour, int] = (dim(CHROME_TONE, 0.6), LAMP) if chrome else (dim(paint, 0.75), PAINT)
        texture.rectangle(Chart.SIDE, (p - 0.24, shape.belt - 0.13), (p - 0.07, shape.belt - 0.09), *handle)
        ring = [(p - 0.25, shape.belt - 0.14), (p - 0.06, shape.belt - 0.14), (p - 0.06, shape.belt - 0.08)]
        texture.emboss(Chart.SIDE, [*ring, (p - 0.25, shape.belt - 0.08)], 0.012)
    if shape.kind == "van":
        rail = [(high, shape.belt - 0.25), (min(high + 1.6, shape.length - 0.3), shape.belt - 0.25)]
        texture.line(Chart.SIDE, rail, seam, PAINT, 0.03)
        texture.groove(Chart.SIDE, rail)
        for p in np.arange(high + 1.3, shape.length - 0.3, 1.1).tolist():
            texture.groove(Chart.SIDE, [(p, foot), (p, shape.height - 0.2)])
    else:
        flap = [(high + 0.1, shape.belt - 0.32), (high + 0.28, shape.belt - 0.32), (high + 0.28, shape.belt - 0.15)]
        texture.groove(Chart.SIDE, [*flap, (high + 0.1, shape.belt - 0.15), flap[0]])


def _draw_top(texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator) -> None:
    half = shape.width / 2
    seam = dim(paint, SEAM)
    roof = (shape.roof_front[0] + 0.12, shape.roof_rear[0] - 0.1)
    edge = cabin_edge(shape, half, shape.height) - 0.12
    if style.dark_roof:
        texture.rectangle(
            Chart.TOP, (shape.roof_front[0] - 0.05, -half), (shape.roof_rear[0] + 0.05, half), BLACK, PAINT
        )
    # A roof is bowed across and a little along.
    crown = [(roof[0], -edge), (roof[1], -edge), (roof[1], edge), (roof[0], edge)]
    if shape.kind not in ("van", "bus") and shape.cargo is None:
        texture.bow(Chart.TOP, crown, (0.03, rng.uniform(0.02, 0.12)))
    ring, placed = _top_pane(texture, shape, style.glass, shape.cowl, shape.roof_front, 0.04)
    draw_behind_windscreen(texture, Chart.TOP, placed, style.glass, style.clear, rng)
    draw_sky_reflection(texture, Chart.TOP, ring, rng)
    draw_dashboard_reflection(texture, Chart.TOP, ring, rng)
    if shape.kind not in ("van", "bus") and shape.cargo is None:
        ring, placed = _top_pane(texture, shape, style.rear_glass, shape.rear_window, shape.roof_rear, 0.12)
        draw_behind_rear_window(texture, Chart.TOP, placed, style.rear_glass, style.rear_clear, rng)
        draw_sky_reflection(texture, Chart.TOP, ring, rng, 0.12 + 0.2 * style.rear_clear)
        texture.line(Chart.TOP, ring[: len(ring) // 2], BLACK, GLASS, 0.05)
    if shape.cowl[0] > 0.6:
        _bonnet(texture, shape, half, seam, rng)
    sunroof = rng.random()
    if style.rails:
        rail = ((0.03, 0.03, 0.031), MATTE) if style.rails == 1 else (dim(CHROME_TONE, 0.5), LAMP)
        for y in (edge, -edge):
            texture.line(Chart.TOP, [(roof[0] + 0.2, y), (roof[1], y)], *rail, width=0.02)
            texture.shadow(Chart.TOP, [(roof[0] + 0.2, y), (roof[1], y)], 0.2, 0.06)
    elif shape.kind != "bus" and shape.cargo is None:
        for y in (edge, -edge):
            tone = BLACK if style.dark_roof else dim(paint, 0.75)
            texture.line(Chart.TOP, [(roof[0], y), (roof[1], y)], tone, PAINT)
            texture.groove(Chart.TOP, [(roof[0], y), (roof[1], y)])
    if sunroof < 0.12 and shape.kind not in ("van", "bus") and shape.cargo is None:
        long = 0.75 if sunroof < 0.09 else roof[1] - roof[0] - 0.3
        long *= rng.uniform(0.7, 1.0)
        ring = [(roof[0], -edge + 0.12), (roof[0] + long, -edge + 0.12), (roof[0] + long, edge - 0.12)]
        draw_sky_reflection(
            texture,
            Chart.TOP,
            draw_window(texture, Chart.TOP, [*ring, (roof[0], edge - 0.12)], (0.012, 0.013, 0.014)),
            rng,
        )
    if shape.kind == "van":
        for d in np.arange(roof[0] + 0.3, roof[1], 0.55).tolist():
            texture.emboss(Chart.TOP, [(d, -edge), (d + 0.2, -edge), (d + 0.2, edge), (d, edge)], 0.006, soft=True)
    if rng.random() < 0.5 and shape.cargo is None and shape.aerial is None:
        d = roof[1] - 0.05
        texture.polygon(Chart.TOP, [(d, -0.03), (d + 0.16, -0.015), (d + 0.16, 0.015), (d, 0.03)], BLACK, PAINT)
    if shape.bed is not None:
        _bed(texture, shape, rng)


def _bed(texture: Texture, shape: Shape, rng: np.random.Generator) -> None:
    """Paint a pickup's load bed: a dark cover, or a shaded floor with things on it."""
    assert shape.bed is not None
    half, start, end = 0.86 * shape.width / 2, shape.bed[0], shape.length - 0.10
    ring = [(start, -half), (end, -half), (end, half), (start, half)]
    if rng.random() < 0.5:
        texture.polygon(Chart.TOP, ring, (0.016, 0.016, 0.017), PAINT)
        for d in np.linspace(start, end, 4)[1:-1].tolist():
            texture.groove(Chart.TOP, [(d, -half), (d, half)], 0.006)
    else:
        level = rng.uniform(0.03, 0.12)
        texture.polygon(Chart.TOP, ring, (level, level, level), MATTE)
        for _ in range(int(rng.integers(0, 9))):
            d, y = rng.uniform(start, end - 0.3), rng.uniform(-half, half)
            long, wide = rng.uniform(0.15, 0.7), rng.uniform(0.1, 0.4)
            tone = np.clip(rng.uniform(0.02, 0.45) * rng.normal(1, 0.15, 3), 0, 1).tolist()
            box = np.clip([(d, y), (d + long, y), (d + long, y + wide), (d, y + wide)], [start, -half], [end, half])
            texture.polygon(Chart.TOP, box, (tone[0], tone[1], tone[2]), MATTE)
        texture.fade(Chart.TOP, ring, BLACK, (0.75, 0.2), level=True)
    texture.shadow(Chart.TOP, [*ring, ring[0]], 0.5, 0.08)


def _top_pane(
    texture: Texture, shape: Shape, glass: Colour, near: tuple[float, float], far: tuple[float, float], gap: float
) -> tuple[Any, ScreenMap]:
    """Paint the part of a windscreen or rear window that chart TOP shows.

    Returns:
        Its outline (N, 2), foot first, and the map from coordinates on it to the drawing.
    """
    half = shape.width / 2
    edge = [cabin_edge(shape, half, z) - 0.04 for _, z in (near, far)]
    d0, d1 = near[0] + gap * (far[0] - near[0]), far[0] - 0.06 * (far[0] - near[0])
    across = np.linspace(1, -1, 9)
    y0, y1 = (edge[0] - 0.02) * across, (edge[1] - 0.025) * across
    # In plan both edges are curved, as the body is.
    lower = np.stack([d0 + setback(shape, d0, y0), y0], axis=1)
    upper = np.stack([d1 + setback(shape, d1, y1), y1], axis=1)
    ring = np.concatenate([lower, upper[::-1]])
    draw_window(texture, Chart.TOP, ring, glass, rim=0.93)
    middle = ring.mean(axis=0)
    inner = middle + 0.94 * (np.concatenate([lower, upper]) - middle)
    half_way = len(across)
    return ring, screen_coordinates(inner[:half_way][::-1], inner[half_way:][::-1])


def _bonnet(texture: Texture, shape: Shape, half: float, seam: Colour, rng: np.random.Generator) -> None:
    """Paint gaps at the bonnet's sides and front, its creases, and wipers."""
    start, back = face_edge(shape)[0], shape.cowl[0] - 0.05

    def bowed(points: list[tuple[float, float]]) -> Any:
        """(d, share of the half-width), d at the body's middle, as the drawing's points."""
        d, y = np.array(points).T
        return np.stack([d + setback(shape, d, y * half), y * half], axis=1)

    inner, rise = rng.uniform(0.3, 0.6), rng.uniform(0.0, 0.003)
    for side in (-1, 1):
        gap = bowed([(start, 0.62 * side), (start + 0.2, 0.70 * side), (back, 0.78 * side)])
        texture.line(Chart.TOP, gap, seam, PAINT)
        texture.groove(Chart.TOP, gap)
        texture.shadow(Chart.TOP, gap, 0.08, 0.04)
        crease = bowed([(start, side * 0.7 * inner), (back, side * inner)])
        texture.groove(Chart.TOP, crease, -rise, 0.09)
        wiper = bowed([(back + 0.04, side * 0.1), (back + 0.07, side * 0.35), (back + 0.10, side * 0.6)])
        texture.line(Chart.TOP, wiper, BLACK, MATTE, 0.02)
    across = np.linspace(-1, 1, 9).tolist()
    texture.line(Chart.TOP, bowed([(start + 0.01, 0.62 * y) for y in across]), seam, PAINT)
    hump = bowed([(start, -0.35), (start, 0.0), (start, 0.35), (back, 0.5), (back, 0.0), (back, -0.5)])
    texture.emboss(Chart.TOP, hump, rng.uniform(0.002, 0.012), soft=True)
    cowl = bowed([*((back, 0.8 * y) for y in across), *((back + 0.11, -0.8 * y) for y in across)])
    texture.polygon(Chart.TOP, cowl, BLACK, MATTE)
