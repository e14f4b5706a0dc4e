"""Fronts and backs of cars and vans: grilles, lamps, bumpers, lids, in several families each."""

from __future__ import annotations

import numpy as np

from labelgen.synth.bodies import cabin_edge, shell_end
from labelgen.synth.fittings import BLACK, CHROME_TONE, TRIM, Style, gleam, mirrored, pane, passengers, plate
from labelgen.synth.mesh import Chart
from labelgen.synth.raster import CHROME, GLASS, LAMP, LIT, MATTE, PAINT
from labelgen.synth.shapes import Shape
from labelgen.synth.skin import Colour, Skin, dim, rounded

__all__ = ["draw_front", "draw_rear"]

_SEAM = 0.3
_REFLECTOR: Colour = (0.55, 0.56, 0.57)
_BEHIND_GLASS: Colour = (0.15, 0.153, 0.158)
_GLOW: Colour = (1.0, 0.97, 0.88)
_LAMP_TALL = 1.25

# Head lamps, left half: (share of the front's half-width, metres below the nose).
_HEAD_LAMPS: tuple[tuple[tuple[float, float], ...], ...] = (
    ((1.04, -0.03), (0.60, -0.10), (0.63, -0.22), (1.04, -0.21)),
    ((1.04, -0.02), (0.52, -0.13), (0.55, -0.18), (0.9, -0.20), (1.04, -0.14)),
    ((1.02, -0.06), (0.70, -0.06), (0.70, -0.24), (1.02, -0.24)),
    ((1.04, -0.04), (0.78, -0.05), (0.72, -0.28), (0.98, -0.30)),
    ((1.04, -0.08), (0.48, -0.12), (0.48, -0.165), (1.04, -0.145)),
    ((1.00, -0.05), (0.86, -0.02), (0.70, -0.06), (0.66, -0.15), (0.72, -0.24), (0.88, -0.26), (1.00, -0.20)),
)


def draw_front(skin: Skin, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool) -> None:
    """Screen, bonnet edge, lamps, grille, bumper and plate."""
    half, nose = shape.width / 2, shape.nose
    narrow = half * (1 - shape.corner)
    foot = shape.clearance + 0.09
    bumper_top = nose - rng.uniform(0.26, 0.34)
    skin.rectangle(Chart.FRONT, (-half, 0), (half, foot + style.cladding), TRIM, MATTE)
    if style.dark_bumpers:
        skin.rectangle(Chart.FRONT, (-half, 0), (half, bumper_top), TRIM, MATTE)
    # The bumper stands out; below the lamps a shadow line.
    skin.emboss(Chart.FRONT, [(-half, 0), (half, 0), (half, bumper_top), (-half, bumper_top)], 0.02)
    _bow_end(skin, Chart.FRONT, half, (foot, bumper_top, nose), rng)
    _windscreen(skin, shape, style, rng)
    _air_dam(skin, narrow, foot + style.cladding, rng)
    _grille(skin, shape, style, narrow, bumper_top, rng)
    _head_lamps(skin, shape, style, narrow, lamps)
    _fog_lamps(skin, narrow, foot + style.cladding + 0.06, rng)
    for line in ([(-narrow, nose - 0.04), (narrow, nose - 0.04)], [(-half, bumper_top), (half, bumper_top)]):
        skin.line(Chart.FRONT, line, dim(paint, 0.55), PAINT, 0.012)
        skin.shadow(Chart.FRONT, line, 0.18)
    low = max(foot + 0.10, bumper_top - rng.uniform(0.06, 0.16))
    plate(skin, Chart.FRONT, (0, low), style.plate, rng)


def _air_dam(skin: Skin, narrow: float, foot: float, rng: np.random.Generator) -> None:
    """Unpainted plastic below the bumper, and the shadow in which its foot lies."""
    high = foot + rng.uniform(0.02, 0.10)
    ring = [(-narrow, foot - 0.12), (narrow, foot - 0.12), (0.95 * narrow, foot), (0.7 * narrow, high)]
    skin.polygon(Chart.FRONT, [*ring, (-0.7 * narrow, high), (-0.95 * narrow, foot)], TRIM, MATTE)
    skin.shadow(Chart.FRONT, [(-narrow, foot), (narrow, foot)], 0.45, 0.16)


def _bow_end(
    skin: Skin, chart: Chart, half: float, heights: tuple[float, float, float], rng: np.random.Generator
) -> None:
    """Round a bumper and the panel above it, both across and from top to bottom. `heights`: their three borders."""
    foot, middle, top = heights
    bumper = [(-half, foot), (half, foot), (half, middle), (-half, middle)]
    skin.bow(chart, bumper, (0.2, rng.uniform(2.4, 4.2)), (0.0, 0.10))
    skin.bow(
        chart, [(-half, middle), (half, middle), (half, top), (-half, top)], (0.25, rng.uniform(1.0, 2.4)), (0.0, 0.05)
    )
    # The ledge on which the upper panel stands catches the sky, what lies under the bumper sees the road alone.
    ledge = [(-half, middle - 0.045), (half, middle - 0.045), (half, middle), (-half, middle)]
    skin.bow(chart, ledge, (0.0, 0.0), (0.0, rng.uniform(0.4, 0.9)))
    skin.shadow(chart, [(-half, foot - 0.02), (half, foot - 0.02)], 0.75, 0.16)


def _windscreen(skin: Skin, shape: Shape, style: Style, rng: np.random.Generator) -> None:
    half = shape.width / 2
    glass_half = cabin_edge(shape, half, shape.cowl[1]) - 0.06
    top_half = cabin_edge(shape, half, shape.roof_front[1]) - 0.08
    ring = [
        (-glass_half, shape.cowl[1]), (glass_half, shape.cowl[1]),
        (top_half, shape.roof_front[1] - 0.03), (-top_half, shape.roof_front[1] - 0.03),
    ]  # fmt: skip
    inner = pane(skin, Chart.FRONT, ring, style.glass)
    passengers(skin, Chart.FRONT, (shape.cowl[1] + 0.05, shape.roof_front[1] - 0.12), 0.62 * half, rng)
    gleam(skin, Chart.FRONT, inner, rng)


def _grille(skin: Skin, shape: Shape, style: Style, narrow: float, bumper_top: float, rng: np.random.Generator) -> None:
    """Openings between and below the lamps."""
    top, foot = shape.nose - 0.06, shape.clearance + 0.08 + style.cladding
    family = style.grille
    # Light comes into the openings, and bars stand in them that hardly part from what lies behind.
    hollow = rng.uniform(0.016, 0.034)
    dark: Colour = (hollow, hollow, 1.04 * hollow)
    bar_tone = rng.uniform(1.2, 1.9)

    def opening(half: float, low: float, high: float, taper: float = 0.0) -> None:
        if high - low < 0.03:
            return
        ring = [(-half + taper, low), (half - taper, low), (half, high), (-half, high)]
        smooth = rounded(ring)
        skin.polygon(Chart.FRONT, smooth, dark, MATTE)
        skin.emboss(Chart.FRONT, smooth, -0.012)
        for z in np.arange(low + 0.03, high - 0.01, 0.045).tolist():
            skin.line(Chart.FRONT, [(-half + taper + 0.02, z), (half - taper - 0.02, z)], dim(dark, bar_tone), MATTE)
        if style.chrome:
            skin.line(Chart.FRONT, np.concatenate([smooth, smooth[:1]]), dim(CHROME_TONE, 0.7), LAMP, 0.012)

    deep = rng.uniform(0.15, 0.27)
    lower = (foot, min(foot + deep, bumper_top - 0.06))
    if family == 0:  # a bar between the lamps, a wide mouth below
        opening(rng.uniform(0.45, 0.6) * narrow, top - rng.uniform(0.12, 0.2), top)
        opening(0.66 * narrow, *lower, 0.05)
    elif family == 1:  # one tall mouth through the bumper
        opening(rng.uniform(0.34, 0.46) * narrow, foot + 0.03, top, 0.08)
        for side in (-1, 1):
            ring = mirrored([(0.55 * narrow, foot), (0.92 * narrow, foot), (0.92 * narrow, foot + 0.15)], side)
            skin.polygon(Chart.FRONT, ring, dark, MATTE)
    elif family == 2:  # two openings side by side
        for side in (-1, 1):
            ring = mirrored([(0.03, top - 0.20), (0.26, top - 0.20), (0.30, top), (0.03, top)], side)
            skin.polygon(Chart.FRONT, rounded(ring), dark, MATTE)
            skin.line(Chart.FRONT, rounded([*ring, ring[0]]), dim(CHROME_TONE, 0.6), CHROME, 0.014)
        opening(0.6 * narrow, *lower)
    elif family == 3:  # a slot above, a big mouth below
        opening(0.5 * narrow, top - 0.07, top)
        opening(0.72 * narrow, foot, bumper_top - 0.02, 0.12)
    elif family == 4:  # upright bars
        opening(0.56 * narrow, top - 0.2, top)
        for y in np.linspace(-0.5, 0.5, 12).tolist():
            bar = [(y * narrow, top - 0.19), (y * narrow, top - 0.01)]
            skin.line(Chart.FRONT, bar, dim(CHROME_TONE, 0.2), CHROME if style.chrome else MATTE, 0.012)
        opening(0.5 * narrow, *lower)
    elif family == 5:  # closed, a mouth below
        skin.emboss(Chart.FRONT, rounded([(-0.4, top - 0.15), (0.4, top - 0.15), (0.45, top), (-0.45, top)]), -0.012)
        opening(0.8 * narrow, *lower, 0.1)
    else:  # a body-wide black band with the lamps in it
        skin.rectangle(Chart.FRONT, (-narrow, top - 0.16), (narrow, top - 0.02), dark, PAINT)
        opening(0.66 * narrow, *lower)
    if rng.random() < 0.85:
        skin.circle(Chart.FRONT, (0, top - 0.07), rng.uniform(0.03, 0.06), CHROME_TONE, CHROME)


def _head_lamps(skin: Skin, shape: Shape, style: Style, narrow: float, lamps: bool) -> None:
    shapes = _HEAD_LAMPS[style.lamp]
    nose, swept = shape.nose, min(0.26 + 0.05 * style.lamp, 0.5 * shape.cowl[0])
    for side in (-1, 1):
        ring = mirrored([(share * narrow, nose + _LAMP_TALL * down) for share, down in shapes], side)
        smooth = rounded(ring)
        middle = np.mean(ring, axis=0)
        skin.polygon(Chart.FRONT, smooth, TRIM, MATTE)
        skin.shadow(Chart.FRONT, np.concatenate([smooth, smooth[:1]]), 0.3, 0.03)
        skin.polygon(Chart.FRONT, middle + 0.86 * (smooth - middle), _BEHIND_GLASS, LAMP)
        skin.bow(Chart.FRONT, smooth, (1.2, 1.5), (0.0, 0.3))
        tall = float(np.ptp(smooth[:, 1]))
        for shift, share in ((-0.04, 0.40), (0.30 * float(np.ptp(smooth[:, 0])), 0.28)):
            spot = (float(middle[0]) - side * shift, float(middle[1]))
            size = min(share * tall, 0.065)
            skin.circle(Chart.FRONT, spot, size, _REFLECTOR, LAMP)
            skin.circle(Chart.FRONT, spot, 0.45 * size, (0.16, 0.16, 0.17), LAMP)
            if lamps and shift < 0:
                skin.circle(Chart.FRONT, spot, 0.055, _GLOW, LIT)
        # What of the lamp lies on the wing, seen from above and from the side.
        inner = min(share for share, _ in shapes)
        ys = (side * (0.5 * inner + 0.5) * narrow, side * 1.06 * narrow)
        on_top = np.array([(0.02, ys[0]), (0.10, ys[0]), (swept, ys[1]), (0.02, ys[1])])
        skin.polygon(Chart.TOP, on_top, _BEHIND_GLASS, LAMP)
        skin.shadow(Chart.TOP, np.concatenate([on_top, on_top[:1]]), 0.4, 0.03)
        centre = on_top.mean(axis=0)
        skin.polygon(Chart.TOP, centre + 0.5 * (on_top - centre), dim(_REFLECTOR, 0.8), LAMP)
    down = [d for _, d in shapes]
    z0, z1 = nose + min(down), nose + max(down) + 0.04
    skin.polygon(Chart.SIDE, [(0, z0), (0, z1), (0.32, z1 + 0.01), (0.2, z0 + 0.04)], (0.12, 0.12, 0.13), LAMP)


def _fog_lamps(skin: Skin, narrow: float, z: float, rng: np.random.Generator) -> None:
    style = int(rng.choice(4, p=[0.3, 0.4, 0.15, 0.15]))
    for side in (-1, 1):
        centre = (side * 0.80 * narrow, z)
        if style == 0:
            skin.circle(Chart.FRONT, centre, 0.075, TRIM, MATTE)
            skin.circle(Chart.FRONT, centre, 0.048, _REFLECTOR, LAMP)
        elif style == 1:
            ring = mirrored([(0.68 * narrow, z - 0.06), (0.98 * narrow, z - 0.06), (0.94 * narrow, z + 0.10)], side)
            skin.polygon(Chart.FRONT, ring, TRIM, MATTE)
        elif style == 2:
            low, high = (side * 0.70 * narrow, z + 0.03), (side * 0.95 * narrow, z + 0.05)
            skin.rectangle(Chart.FRONT, low, high, (0.6, 0.6, 0.6), LAMP)


# Tail lamps, left half: (share of the half-width, share of the lamp's height below its top).
_TAIL_LAMPS: tuple[tuple[tuple[float, float], ...], ...] = (
    ((1.05, 0.0), (0.62, 0.0), (0.66, 1.0), (1.05, 1.0)),
    ((1.05, -0.6), (0.84, -0.6), (0.82, 1.0), (1.05, 1.0)),
    ((1.05, 0.0), (0.45, 0.25), (0.50, 0.75), (1.05, 0.9)),
    ((1.05, -0.9), (0.88, -0.9), (0.86, 0.2), (0.55, 0.3), (0.58, 0.9), (1.05, 1.0)),
    ((1.02, 0.0), (0.72, 0.0), (0.72, 0.85), (1.02, 0.85)),
    ((1.05, 0.2), (0.05, 0.3), (0.05, 0.6), (1.05, 0.8)),
)


def draw_rear(skin: Skin, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool) -> None:
    """Rear window or doors, lid, lamps, bumper and plate."""
    half, seam = shape.width / 2, dim(paint, _SEAM)
    braking = bool(rng.random() < 0.12)
    narrow = half * (1 - 0.6 * shape.corner)
    foot = shape.clearance + 0.10 + style.cladding
    bumper_top = shape.clearance + rng.uniform(0.26, 0.36)
    skin.rectangle(Chart.REAR, (-half, 0), (half, foot), TRIM, MATTE)
    if style.dark_bumpers:
        skin.rectangle(Chart.REAR, (-half, 0), (half, bumper_top), TRIM, MATTE)
    skin.emboss(Chart.REAR, [(-half, 0), (half, 0), (half, bumper_top), (-half, bumper_top)], 0.02)
    skin.line(Chart.REAR, [(-half, bumper_top), (half, bumper_top)], seam, PAINT, 0.018)
    skin.shadow(Chart.REAR, [(-half, bumper_top + 0.01), (half, bumper_top + 0.01)], 0.45)
    if shape.kind != "van" and shape.cargo is None:
        _bow_end(skin, Chart.REAR, half, (foot, bumper_top, shape.tail), rng)
    if rng.random() < 0.85:  # unpainted below the bumper's middle
        top_z = foot + rng.uniform(0.05, 0.16)
        ring = [(-0.75 * narrow, foot), (0.75 * narrow, foot), (0.6 * narrow, top_z), (-0.6 * narrow, top_z)]
        skin.polygon(Chart.REAR, ring, TRIM, MATTE)
    if shape.kind == "van":
        _rear_doors(skin, shape, style, seam, rng)
    elif shape.cargo is None:
        _rear_screen(skin, shape, style, braking, rng)
    top, tall = shape.tail - 0.04, rng.uniform(0.12, 0.22)
    if shape.kind == "van":
        top, tall = 1.15, 0.3
    _tail_lamps(skin, shape, style, narrow, top, tall, rng, lamps, braking)
    lid = 0.82 * narrow
    for points in ([(-lid, bumper_top), (-lid, top)], [(lid, bumper_top), (lid, top)]):
        skin.line(Chart.REAR, points, dim(paint, 0.55), PAINT)
        skin.groove(Chart.REAR, points, 0.004)
    crease = top - tall * rng.uniform(0.2, 1.0)
    skin.emboss(Chart.REAR, [(-lid, crease), (lid, crease), (lid, top + 0.3), (-lid, top + 0.3)], 0.02, soft=True)
    if rng.random() < 0.55:
        skin.rectangle(Chart.REAR, (-0.3, top - tall - 0.01), (0.3, top - tall + 0.015), CHROME_TONE, CHROME)
    skin.circle(Chart.REAR, (0, top - 0.06), rng.uniform(0.025, 0.04), BLACK, PAINT)
    skin.circle(Chart.REAR, (0, top - 0.06), 0.024, CHROME_TONE, CHROME)
    if rng.random() < 0.7:
        _model_names(skin, narrow, top, tall, rng)
    high = max(bumper_top + 0.08, top - tall - 0.05)
    plate(skin, Chart.REAR, (0, high if style.plate_high else max(foot + 0.04, bumper_top - 0.1)), style.plate, rng)
    for side in (-1, 1):
        low = (side * 0.72 * narrow, foot + 0.04)
        skin.rectangle(Chart.REAR, low, (side * 0.95 * narrow, foot + 0.065), (0.08, 0.014, 0.015), LAMP)
    if rng.random() < 0.5:
        skin.circle(Chart.REAR, (0.6 * narrow, shape.clearance + 0.05), 0.035, (0.15, 0.15, 0.15), CHROME)


def _model_names(skin: Skin, narrow: float, top: float, tall: float, rng: np.random.Generator) -> None:
    """Letters of chrome on the lid, beside the badge."""
    z = top - rng.uniform(0.1, 0.9) * tall
    for side in (-1, 1) if rng.random() < 0.6 else (int(rng.choice([-1, 1])),):
        start, count = rng.uniform(0.22, 0.4) * narrow, int(rng.integers(2, 7))
        for k in range(count):
            y = side * (start + 0.034 * k)
            skin.rectangle(Chart.REAR, (y - 0.008, z - 0.011), (y + 0.008, z + 0.011), CHROME_TONE, LAMP)


def _rear_doors(skin: Skin, shape: Shape, style: Style, seam: Colour, rng: np.random.Generator) -> None:
    middle = [(0, shape.height), (0, 0.4)]
    skin.line(Chart.REAR, middle, seam, PAINT, 0.02)
    skin.groove(Chart.REAR, middle)
    if rng.random() < 0.6:
        for side in (-1, 1):
            ring = mirrored([(0.10, 1.35), (0.72, 1.35), (0.70, 1.95), (0.10, 1.95)], side)
            gleam(skin, Chart.REAR, pane(skin, Chart.REAR, ring, style.rear_glass), rng)
    for side in (-1, 1):
        for z in (0.8, 1.7):
            skin.rectangle(Chart.REAR, (side * 0.86, z), (side * 0.93, z + 0.08), TRIM, MATTE)
    skin.rectangle(Chart.REAR, (0.04, 1.0), (0.16, 1.06), TRIM, MATTE)


def _rear_screen(skin: Skin, shape: Shape, style: Style, braking: bool, rng: np.random.Generator) -> None:
    half = shape.width / 2
    low, high = shape.rear_window, shape.roof_rear
    y0, y1 = cabin_edge(shape, half, low[1]) - 0.10, cabin_edge(shape, half, high[1]) - 0.12
    ring = [(-y0, low[1] + 0.03), (y0, low[1] + 0.03), (y1, high[1] - 0.05), (-y1, high[1] - 0.05)]
    inner = pane(skin, Chart.REAR, ring, style.rear_glass)
    passengers(skin, Chart.REAR, (low[1] + 0.06, high[1] - 0.08), 0.7 * half, rng, rear=True)
    gleam(skin, Chart.REAR, inner, rng)
    if shape.kind != "saloon" and rng.random() < 0.6:
        wiper = [(0.0, low[1] + 0.04), (0.35, low[1] + 0.12)]
        skin.line(Chart.REAR, wiper, BLACK, MATTE, 0.02)
    third: tuple[Colour, int] = ((0.6, 0.08, 0.08), LIT) if braking else ((0.06, 0.010, 0.011), GLASS)
    skin.rectangle(Chart.REAR, (-0.14, high[1] - 0.075), (0.14, high[1] - 0.04), *third)


def _tail_lamps(
    skin: Skin, shape: Shape, style: Style, narrow: float, top: float, tall: float, rng: np.random.Generator,
    lamps: bool, braking: bool,
) -> None:  # fmt: skip
    family = _TAIL_LAMPS[style.rear_lamp]
    # Unlit ones are dark red, and greyed by what they mirror; those across the whole lid shine at their ends alone.
    bright, wide = rng.uniform(0.7, 1.3), style.rear_lamp == 5
    unlit: Colour = (0.21 * bright, 0.017, 0.024)
    red: Colour = unlit
    if lamps:
        red = (0.30, 0.016, 0.02)
    if braking:
        red = (0.42, 0.034, 0.045)
    clear: Colour = dim((0.22, 0.19, 0.185), rng.uniform(0.7, 1.4))
    shining = LIT if lamps or braking else LAMP
    lift, pale, mirrored_sky = rng.uniform(-0.12, 0.2), rng.random() < 0.4, rng.uniform(0.05, 0.3)
    for side in (-1, 1):
        ring = mirrored([(share * narrow, top - down * tall) for share, down in family], side)
        smooth = rounded(ring, 0.06)
        middle = np.mean(ring, axis=0)
        inner = middle + 0.88 * (smooth - middle)
        skin.polygon(Chart.REAR, smooth, dim(unlit, 0.2), LAMP)
        skin.polygon(Chart.REAR, inner, unlit, LAMP)
        # A lamp is a bowl behind bowed glass: its foot lies in shadow, a part of it shines, a dark gap runs around.
        skin.fade(Chart.REAR, inner, dim(unlit, 0.12), (0.0, rng.uniform(0.5, 0.9)))
        skin.shadow(Chart.REAR, np.concatenate([smooth, smooth[:1]]), 0.55, 0.035)
        heart = np.array([side * 0.88 * narrow, middle[1]]) if wide else middle + np.array([0, lift * tall])
        size = 0.15 if wide else 0.55
        if shining == LIT:
            skin.polygon(Chart.REAR, heart + size * (smooth - middle), red, LIT)
            core: Colour = (0.62, 0.085, 0.10) if braking else dim(red, 1.5)
            skin.polygon(Chart.REAR, heart + 0.6 * size * (smooth - middle), core, LIT)
        else:
            skin.polygon(Chart.REAR, heart + 0.7 * size * (smooth - middle), dim(unlit, 1.6), LAMP)
        skin.bow(Chart.REAR, smooth, (1.5, 2.0), (0.0, 0.2))
        low = (side * 0.86 * narrow, top - 0.72 * tall)
        if style.rear_lamp in (0, 3, 4) or (not wide and pale):
            inwards = style.rear_lamp in (2, 4)
            ends = (side * 0.62 * narrow, side * 0.80 * narrow) if inwards else (low[0], side * 1.02 * narrow)
            skin.rectangle(Chart.REAR, (ends[0], low[1]), (ends[1], low[1] + 0.2 * tall), clear, LAMP)
        # The sky lies over its upper edge.
        skin.fade(Chart.REAR, inner, (0.24, 0.25, 0.27), (mirrored_sky, 0.0))
        if style.rear_lamp == 1:
            skin.rectangle(
                Chart.REAR, (side * 0.88 * narrow, top), (side * 1.0 * narrow, top + 0.03), (0.24, 0.12, 0.035), LAMP
            )
    end = shell_end(shape)
    reach = max(-down for _, down in family) * tall
    skin.rectangle(Chart.SIDE, (end - 0.20, top - 0.8 * tall), (end, top + max(reach, 0.0)), unlit, LAMP)
