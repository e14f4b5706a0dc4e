"""Paint cargo bodies of lorries, and sides, roofs and rears of buses."""

from __future__ import annotations

import numpy as np

from labelgen.synth.shading.materials import GLASS, LAMP, LIT, MATTE, PAINT
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.lettering import TRADES, company_name, letter_cargo, letter_colour, telephone
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.parts import BLACK, TRIM, Style, draw_plate, draw_sky_reflection, draw_window
from labelgen.synth.vehicle.texture import Colour, Texture, dim, rounded

__all__ = ["draw_bus", "draw_bus_rear", "draw_cargo"]

_STEEL: Colour = (0.26, 0.26, 0.27)


def draw_cargo(
    texture: Texture, shape: Shape, colour: Colour, style: Style, rng: np.random.Generator, *, lamps: bool
) -> None:
    """Paint a cargo body: panels or curtains, lettering, doors, lamps, side guards."""
    assert shape.cargo is not None
    start, low, high = shape.cargo
    half, length = shape.width / 2, shape.length
    seam = dim(colour, 0.5)
    texture.rectangle(Chart.SIDE, (start + 0.15, 0), (length + 0.1, low), TRIM, MATTE)
    for d in (start + 0.5, start + 2.0):  # tanks and boxes below
        level = rng.uniform(0.03, 0.22)
        if rng.random() < 0.7:
            ring = [(d, 0.48), (d + 1.1, 0.48), (d + 1.1, low - 0.1), (d, low - 0.1)]
            texture.polygon(Chart.SIDE, rounded(ring, 0.06), (level, level, level), MATTE)
    texture.rectangle(Chart.SIDE, (start - 0.05, low - 0.05), (length + 0.1, high + 0.1), colour, PAINT)
    texture.rectangle(Chart.TOP, (start - 0.05, -half - 0.3), (length + 0.1, half + 0.3), dim(colour, 0.9), MATTE)
    _stains(texture, (start, length), half, rng)
    texture.rectangle(Chart.REAR, (-half - 0.2, low - 0.05), (half + 0.2, high + 0.1), colour, PAINT)
    texture.rectangle(Chart.FRONT, (-half - 0.2, shape.roof_rear[1] + 0.1), (half + 0.2, high + 0.1), colour, PAINT)
    texture.rectangle(Chart.REAR, (-half, 0), (half, low - 0.05), TRIM, MATTE)
    curtain = rng.random() < 0.45
    gap = rng.uniform(0.35, 0.7) if curtain else rng.uniform(0.8, 2.0)
    for d in np.arange(start + gap, length, gap).tolist():
        if curtain:
            texture.emboss(Chart.SIDE, [(d, low), (d + 0.12, low), (d + 0.12, high), (d, high)], 0.03, soft=True)
            texture.rectangle(Chart.SIDE, (d, low - 0.02), (d + 0.05, low + 0.14), (0.1, 0.1, 0.1), MATTE)
        else:
            texture.groove(Chart.SIDE, [(d, low), (d, high)])
            texture.line(Chart.SIDE, [(d, low), (d, high)], dim(colour, 0.8), PAINT)
    letter_cargo(texture, shape, start, rng)
    for edge in (low + 0.04, high - 0.04):
        texture.line(Chart.SIDE, [(start, edge), (length, edge)], _STEEL, MATTE, 0.06)
        texture.line(Chart.REAR, [(-half, edge), (half, edge)], _STEEL, MATTE, 0.08)
    _back_doors(texture, half, low, high, seam, rng)
    striped = rng.random() < 0.35
    red: Colour = (0.40, 0.03, 0.03) if lamps else (0.22, 0.018, 0.024)
    for side in (-1, 1):
        texture.rectangle(Chart.REAR, (side * 0.70, 0.46), (side * 1.14, 0.62), BLACK, MATTE)
        texture.rectangle(Chart.REAR, (side * 0.74, 0.49), (side * 0.98, 0.59), red, LIT if lamps else LAMP)
        texture.rectangle(Chart.REAR, (side * 0.99, 0.49), (side * 1.08, 0.57), (0.24, 0.12, 0.035), LAMP)
        for k in range(5) if striped else ():
            y = side * (0.06 + 0.13 * k)
            tone: Colour = (0.30, 0.03, 0.03) if k % 2 else (0.5, 0.5, 0.48)
            texture.polygon(Chart.REAR, [(y, 0.47), (y + 0.1, 0.47), (y + 0.14, 0.61), (y + 0.04, 0.61)], tone, PAINT)
    if rng.random() < 0.6:  # reflecting strips along the edges
        for k, d in enumerate(np.arange(start, length, 0.3).tolist()):
            if k % 2:
                texture.rectangle(Chart.SIDE, (d, low + 0.09), (d + 0.25, low + 0.13), (0.34, 0.19, 0.06), PAINT)
        for z0, z1 in ((low + 0.1, low + 0.16), (high - 0.16, high - 0.1))[: int(rng.integers(1, 3))]:
            texture.rectangle(Chart.REAR, (-half + 0.1, z0), (half - 0.1, z1), (0.24, 0.04, 0.035), PAINT)
    _grime(texture, shape, rng)
    worn = rng.uniform(0.08, 0.4)
    _weather_walls(texture, worn, rng)
    texture.weather(Chart.TOP, 0.0, worn, rng)
    draw_plate(texture, Chart.REAR, (0, 0.55), style.plate, rng)


def _weather_walls(texture: Texture, worn: float, rng: np.random.Generator) -> None:
    for chart in (Chart.SIDE, Chart.REAR, Chart.FRONT):
        texture.weather(chart, worn, 0.5 * worn, rng)


def _stains(texture: Texture, ends: tuple[float, float], half: float, rng: np.random.Generator) -> None:
    """Paint stains of rain and leaves on a roof, and joints between its sheets."""
    start, end = ends
    sheet = [(start, -half), (end, -half), (end, half), (start, half)]
    veil = rng.uniform(0.1, 0.45)
    texture.fade(Chart.TOP, sheet, _GRIME, (veil, veil * rng.uniform(0.5, 1.2)), level=True)
    for _ in range(int(rng.integers(10, 30))):
        d, y = rng.uniform(start, end), rng.uniform(-half, half)
        angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
        reach = rng.uniform(0.1, 0.9) * rng.uniform(0.6, 1.4, 12)
        blot = np.stack([d + 1.5 * reach * np.cos(angle), y + 0.6 * reach * np.sin(angle)], axis=1)
        texture.fade(Chart.TOP, blot.clip([start, -half], [end, half]), _GRIME, (rng.uniform(0.02, 0.10),) * 2)
    for d in np.arange(start + rng.uniform(0.6, 1.5), end, rng.uniform(0.9, 2.4)).tolist():
        texture.groove(Chart.TOP, [(d, -half), (d, half)], 0.006)
        texture.shadow(Chart.TOP, [(d, -half), (d, half)], 0.12, 0.04)


def _grime(texture: Texture, shape: Shape, rng: np.random.Generator) -> None:
    """Paint spray from the wheels and streaks below the roof, and bend panels a little."""
    assert shape.cargo is not None
    start, low, high = shape.cargo
    half, length = shape.width / 2, shape.length
    side = [(start, low), (length, low), (length, high), (start, high)]
    back = [(-half, low), (half, low), (half, high), (-half, high)]
    for chart, ring in ((Chart.SIDE, side), (Chart.REAR, back)):
        texture.fade(chart, ring, _GRIME, (rng.uniform(0.05, 0.3), rng.uniform(0.3, 0.75)))
        texture.bow(chart, ring, (0.02, rng.uniform(0.02, 0.08)))
    for _ in range(int(rng.integers(3, 12))):
        d, long = rng.uniform(start, length), rng.uniform(0.3, 1.6)
        texture.shadow(
            Chart.SIDE, [(d, high), (d + rng.uniform(-0.05, 0.05), high - long)], rng.uniform(0.03, 0.12), 0.08
        )
        y = rng.uniform(-half, half)
        texture.shadow(Chart.REAR, [(y, high), (y, high - long)], rng.uniform(0.03, 0.12), 0.08)


def _back_doors(texture: Texture, half: float, low: float, high: float, seam: Colour, rng: np.random.Generator) -> None:
    texture.line(Chart.REAR, [(0, low), (0, high)], seam, PAINT, 0.02)
    texture.groove(Chart.REAR, [(0, low), (0, high)])
    inner, outer = rng.uniform(0.10, 0.3), rng.uniform(0.5, 0.8)
    rods = ((-inner, inner), (-outer, -inner, inner, outer), (inner,))[int(rng.integers(3))]
    for y in rods:
        texture.line(Chart.REAR, [(y * half, low), (y * half, high)], _STEEL, MATTE, 0.03)
        texture.rectangle(Chart.REAR, (y * half - 0.04, low + 0.5), (y * half + 0.10, low + 0.56), TRIM, MATTE)
    for side in (-1, 1):
        for z in np.linspace(low + 0.2, high - 0.2, 4).tolist():
            texture.rectangle(Chart.REAR, (side * (half - 0.12), z), (side * half, z + 0.06), _STEEL, MATTE)


_RUBBER: Colour = (0.014, 0.014, 0.015)
_GRIME: Colour = (0.11, 0.105, 0.095)


def draw_bus(texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator) -> None:
    """Paint a bus's sides and roof, and the sign above its windscreen."""
    foot = shape.clearance
    grey = float(rng.uniform(0.05, 0.2))
    skirt = dim(paint, rng.uniform(0.45, 0.8)) if rng.random() < 0.55 else (grey, grey, 1.03 * grey)
    edge = foot + rng.uniform(0.22, 0.45)
    texture.rectangle(Chart.SIDE, (0, foot + 0.03), (shape.length, edge), skirt, PAINT)
    if rng.random() < 0.5:  # a band that rises to the rear
        at, tall = rng.uniform(0.5, 0.75) * shape.length, rng.uniform(0.12, 0.3)
        ring = [(0, edge), (at, edge), (at + 1.6, shape.belt), (at + 2.6, shape.belt), (at + 1.2, edge + tall)]
        texture.polygon(Chart.SIDE, [*ring, (0, edge + tall)], _faded_colour(paint, rng), PAINT)
    if rng.random() < 0.65:  # an advertisement
        left, right = rng.uniform(3.0, 4.5), shape.length - rng.uniform(0.5, 3.0)
        texture.rectangle(Chart.SIDE, (left, edge + 0.03), (right, shape.belt - 0.1), _faded_colour(paint, rng), PAINT)
        for at in np.arange(left + 0.2, right - 1.0, 1.6).tolist():
            if rng.random() < 0.7:
                texture.text(
                    Chart.SIDE, (at, edge + rng.uniform(0.08, 0.2)), company_name(rng), 0.2, letter_colour(rng), PAINT
                )
    for d in np.arange(1.2, shape.length - 0.5, 1.25).tolist():
        texture.groove(Chart.SIDE, [(d, foot), (d, edge)], 0.006)
        texture.line(Chart.SIDE, [(d, foot + 0.05), (d, edge)], dim(skirt, 0.7), PAINT)
    for z in (edge, shape.belt - 0.1):
        texture.groove(Chart.SIDE, [(0.1, z), (shape.length - 0.1, z)], 0.006)
        texture.shadow(Chart.SIDE, [(0.1, z), (shape.length - 0.1, z)], 0.25, 0.03)
    texture.fade(
        Chart.SIDE, [(0, 0.1), (shape.length, 0.1), (shape.length, shape.belt), (0, shape.belt)], _GRIME, (0.0, 0.45)
    )
    _bus_glazing(texture, shape, paint, rng)
    for axle in shape.axles:
        for grow, tone in ((1.26, dim(skirt, 0.6)), (1.13, (0.005, 0.005, 0.005))):
            texture.circle(Chart.SIDE, (axle, shape.wheel), grow * shape.wheel, tone, MATTE)
    for d in (0.35, 5.6):
        top = shape.height - 0.48
        texture.rectangle(Chart.SIDE, (d, foot + 0.12), (d + 1.15, top + 0.05), _RUBBER, PAINT)
        for left in (d + 0.06, d + 0.62):
            ring = [(left, foot + 0.2), (left + 0.48, foot + 0.2), (left + 0.48, top), (left, top)]
            texture.polygon(Chart.SIDE, ring, (0.02, 0.022, 0.023), GLASS)
            texture.fade(Chart.SIDE, ring, (0.12, 0.135, 0.15), (0.5, 0.05))
    _sign(texture, Chart.FRONT, 0.0, shape.height - 0.40, 0.66, rng)
    _weather_walls(texture, rng.uniform(0.05, 0.25), rng)
    _bus_roof(texture, shape, paint, rng)


def _faded_colour(paint: Colour, rng: np.random.Generator) -> Colour:
    """Sample a colour for bands and letters that is close to a bus's own."""
    red, green, blue = (0.35 * np.array(letter_colour(rng)) + rng.uniform(0.25, 0.6) * np.array(paint)).tolist()
    return red, green, blue


def _bus_glazing(texture: Texture, shape: Shape, paint: Colour, rng: np.random.Generator) -> None:
    """Paint a bus's side windows: pillars, opening top lights, seats behind, reflected sky."""
    low, high, end = shape.belt - 0.02, shape.height - 0.42, shape.length - rng.uniform(0.3, 1.0)
    texture.rectangle(Chart.SIDE, (0.12, low), (end, high), _RUBBER, GLASS)
    wide, pillar = rng.uniform(1.15, 1.7), rng.uniform(0.06, 0.13)
    post: Colour = dim(paint, 0.8) if rng.random() < 0.6 else (0.03, 0.03, 0.031)
    lights = low + 0.68 * (high - low) if rng.random() < 0.6 else None
    tint = rng.uniform(0.006, 0.02)
    for left in np.arange(0.2, end - 0.6, wide).tolist():
        right = min(left + wide - pillar, end - 0.08)
        tone = tint * rng.uniform(0.75, 1.35)
        ring = [(left, low + 0.06), (right, low + 0.06), (right, high - 0.05), (left, high - 0.05)]
        texture.polygon(Chart.SIDE, ring, (0.95 * tone, tone, 1.02 * tone), GLASS)
        for seat in np.arange(left + 0.1, right - 0.35, 0.72).tolist():
            back, shade = seat + 0.3, rng.uniform(0.5, 2.2) * tone
            high_seat = low + rng.uniform(0.25, 0.4)
            corners = [(seat, low + 0.06), (back, low + 0.06), (back - 0.05, high_seat), (seat + 0.05, high_seat)]
            texture.polygon(Chart.SIDE, corners, (shade, shade, 1.1 * shade), GLASS)
        if rng.random() < 0.45:  # a passenger
            at, shade = rng.uniform(left + 0.2, right - 0.2), rng.uniform(0.02, 0.2)
            texture.circle(Chart.SIDE, (at, low + 0.42), 0.11, dim((1.0, 0.7, 0.6), 0.5 * shade), GLASS)
            shoulders = [
                (at - 0.2, low + 0.06),
                (at + 0.2, low + 0.06),
                (at + 0.14, low + 0.32),
                (at - 0.14, low + 0.32),
            ]
            texture.polygon(Chart.SIDE, shoulders, (shade, 0.9 * shade, shade), GLASS)
        # Each pane reflects another part of the roadside.
        level = rng.uniform(0.06, 0.3)
        texture.fade(Chart.SIDE, ring, (0.85 * level, level, level), (rng.uniform(0.1, 0.6), rng.uniform(0.0, 0.15)))
        texture.rectangle(Chart.SIDE, (right, low + 0.02), (right + pillar, high - 0.02), post, PAINT)
        if lights is not None:
            texture.line(Chart.SIDE, [(left, lights), (right, lights)], (0.05, 0.05, 0.05), MATTE, 0.035)
    for z in (low, high):
        texture.shadow(Chart.SIDE, [(0.1, z), (end, z)], 0.3, 0.04)


def _bus_roof(texture: Texture, shape: Shape, paint: Colour, rng: np.random.Generator) -> None:
    """Paint a bus's roof: dust, panels, air conditioner and hatches."""
    half, length = shape.width / 2, shape.length
    pale = float(rng.uniform(0.30, 0.5))
    tone: Colour = dim(paint, 0.9) if rng.random() < 0.5 else (pale, pale, 0.99 * pale)
    sheet = [(0.5, -half), (length, -half), (length, half), (0.5, half)]
    texture.polygon(Chart.TOP, sheet, tone, MATTE)
    texture.fade(Chart.TOP, sheet, _GRIME, (0.1, rng.uniform(0.2, 0.4)), level=True)
    texture.bow(Chart.TOP, sheet, (0.0, 0.16))
    for side in (-1, 1):
        texture.shadow(Chart.TOP, [(0.5, side * 0.8 * half), (length, side * 0.8 * half)], 0.15, 0.08)
    for d in np.arange(1.6, length - 0.5, rng.uniform(1.4, 2.2)).tolist():
        texture.groove(Chart.TOP, [(d, -0.85 * half), (d, 0.85 * half)], 0.004)
    if shape.roof_unit is not None:
        start, long, wide, _ = shape.roof_unit
        wide /= 2
        unit = [(start, -wide), (start + long, -wide), (start + long, wide), (start, wide)]
        texture.polygon(Chart.TOP, unit, dim(tone, rng.uniform(0.7, 1.15)), MATTE)
        texture.shadow(Chart.TOP, [*unit, unit[0]], 0.45, 0.12)
        fans = int(rng.integers(2, 6))
        for k in range(fans):
            for side in (-1, 1) if fans < 4 else ((-1) ** k,):
                at = (start + (k + 0.5) * long / fans, 0.45 * wide * side)
                texture.circle(Chart.TOP, at, 0.24, dim(tone, 0.4), MATTE)
                texture.circle(Chart.TOP, at, 0.07, dim(tone, 0.7), MATTE)
    texture.weather(Chart.TOP, 0.0, rng.uniform(0.1, 0.3), rng)
    for d in (0.12 * length, 0.85 * length):
        hatch = [(d, -0.36), (d + 0.7, -0.36), (d + 0.7, 0.36), (d, 0.36)]
        texture.polygon(Chart.TOP, rounded(hatch, 0.08), dim(tone, rng.uniform(0.75, 1.1)), MATTE)
        texture.emboss(Chart.TOP, hatch, 0.02, soft=True)
        texture.shadow(Chart.TOP, [*hatch, hatch[0]], 0.2, 0.04)


def _sign(texture: Texture, chart: Chart, y: float, z: float, wide: float, rng: np.random.Generator) -> None:
    """Paint the sign with the line's number and destination, mostly off, and dim where it is on."""
    texture.rectangle(chart, (y - wide, z), (y + wide, z + 0.20), (0.012, 0.012, 0.013), GLASS)
    lit = rng.random() < 0.3
    tone: Colour = dim((0.22, 0.125, 0.035), rng.uniform(0.6, 1.2)) if lit else (0.035, 0.033, 0.028)
    for left in np.arange(y - 0.8 * wide, y + 0.75 * wide, 0.13).tolist():
        if rng.random() < 0.8:
            low = z + rng.uniform(0.05, 0.08)
            texture.rectangle(chart, (left, low), (left + 0.07, low + 0.08), tone, LIT if lit else GLASS)


def _advertisement(texture: Texture, place: tuple[float, float, float], rng: np.random.Generator) -> None:
    """Paint a poster on a bus's back; `place` is its half width, foot and top, metres."""
    half, low, high = place
    if high - low < 0.3:
        return
    texture.rectangle(Chart.REAR, (-half, low), (half, high), letter_colour(rng), PAINT)
    y, z = rng.uniform(-0.6, 0.6) * half, rng.uniform(low, high)
    reach = min(high - z, z - low) + 0.1
    ring = np.stack(
        [y + 0.5 * half * np.cos(np.arange(12) * np.pi / 6), z + reach * np.sin(np.arange(12) * np.pi / 6)], 1
    )
    texture.polygon(Chart.REAR, ring.clip([-half, low], [half, high]), letter_colour(rng), PAINT)
    size = rng.uniform(0.07, 0.13)
    for line in np.arange(low + 0.06, high - size, 1.6 * size).tolist():
        words = f"{company_name(rng)} {rng.choice(TRADES)}" if rng.random() < 0.6 else telephone(rng)
        small = min(size, 1.6 * half / len(words))
        texture.text(Chart.REAR, (-0.85 * half, line), words, small, letter_colour(rng), PAINT)


def draw_bus_rear(
    texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, *, lamps: bool
) -> None:
    """Paint a bus's rear: window, sign, engine cover, stacked lamps, bumper and plate."""
    half, high, braking = shape.width / 2, shape.height, bool(rng.random() < 0.1)
    bumper = shape.clearance + rng.uniform(0.28, 0.4)
    if rng.random() < 0.5:  # a lower part in a tone of its own
        texture.rectangle(Chart.REAR, (-half, 0), (half, rng.uniform(0.9, 1.3)), _faded_colour(paint, rng), PAINT)
    texture.rectangle(Chart.REAR, (-half, 0), (half, bumper), dim(paint, 0.4) if rng.random() < 0.5 else TRIM, MATTE)
    texture.groove(Chart.REAR, [(-half, bumper), (half, bumper)])
    texture.shadow(Chart.REAR, [(-half, bumper), (half, bumper)], 0.4, 0.05)
    low, top = rng.uniform(1.65, 1.95), high - rng.uniform(0.55, 0.75)
    ring = [(-0.80 * half, low), (0.80 * half, low), (0.74 * half, top), (-0.74 * half, top)]
    inner = draw_window(texture, Chart.REAR, ring, style.rear_glass)
    for y in np.linspace(-0.55, 0.55, 5).tolist():  # the last row of seats
        tone = rng.uniform(0.015, 0.05)
        back = [(y * half - 0.17, low + 0.08), (y * half + 0.17, low + 0.08), (y * half + 0.13, low + 0.3)]
        texture.polygon(Chart.REAR, [*back, (y * half - 0.13, low + 0.3)], (tone, tone, 1.1 * tone), GLASS)
    draw_sky_reflection(texture, Chart.REAR, inner, rng, 0.6)
    if rng.random() < 0.75:
        _sign(texture, Chart.REAR, rng.uniform(-0.3, 0.3), top + 0.08, rng.uniform(0.3, 0.7), rng)
    for z in (low - 0.1, 0.5 * (bumper + low) - 0.1):  # the cover's and the lid's gaps
        texture.line(Chart.REAR, [(-0.8 * half, z), (0.8 * half, z)], dim(paint, 0.6), PAINT)
        texture.groove(Chart.REAR, [(-0.8 * half, z), (0.8 * half, z)], 0.006)
    vent = (-rng.uniform(0.3, 0.6) * half, bumper + 0.25)
    texture.rectangle(Chart.REAR, vent, (-vent[0], vent[1] + 0.28), dim(paint, 0.4), MATTE)
    for z in np.arange(vent[1] + 0.03, vent[1] + 0.27, 0.06).tolist():
        texture.line(Chart.REAR, [(vent[0], z), (-vent[0], z)], dim(paint, 0.22), MATTE, 0.02)
    if rng.random() < 0.8:  # an advertisement: a picture, and lines of letters on it
        _advertisement(texture, (0.7 * half, vent[1] + 0.36, low - 0.16), rng)
    red: Colour = (0.18, 0.017, 0.022)
    for side in (-1, 1):
        y = side * 0.86 * half
        well = [
            (y - 0.10, bumper + 0.08),
            (y + 0.10, bumper + 0.08),
            (y + 0.10, bumper + 0.62),
            (y - 0.10, bumper + 0.62),
        ]
        texture.polygon(Chart.REAR, rounded(well, 0.08), TRIM, MATTE)
        for k, plain in enumerate((red, (0.20, 0.10, 0.03), red)):
            shines = (k == 0 and (braking or lamps)) or (k == 2 and braking)
            colour: Colour = (0.30, 0.024, 0.03) if shines else plain
            texture.circle(Chart.REAR, (y, bumper + 0.17 + 0.18 * k), 0.075, colour, LIT if shines else LAMP)
        texture.rectangle(Chart.REAR, (y - 0.07, high - 0.3), (y + 0.07, high - 0.26), red, LAMP)
    texture.fade(Chart.REAR, [(-half, 0), (half, 0), (half, low), (-half, low)], _GRIME, (0.0, 0.4))
    draw_plate(texture, Chart.REAR, (0, bumper + 0.1), style.plate, rng)
