"""Fronts of cars and vans: grilles, lamps, intakes and bumpers, in several families each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.bodies import cabin_edge, face_edge, setback
from labelgen.synth.cabin import behind_windscreen, on_screen
from labelgen.synth.fittings import CHROME_TONE, GLOW, SILL, TRIM, Style, gleam, mirrored, pane, plate
from labelgen.synth.mesh import Chart
from labelgen.synth.raster import LAMP, LIT, MATTE, PAINT
from labelgen.synth.shapes import Shape
from labelgen.synth.skin import Colour, Skin, dim, rounded

__all__ = ["draw_front"]

_REFLECTOR: Colour = (0.55, 0.56, 0.57)
Points = list[tuple[float, float]]

# Head lamps, one half: (share of the half-width, share of the face's height from its foot to the bonnet's edge).
_HEAD_LAMPS: tuple[tuple[tuple[float, float], ...], ...] = (
    ((0.97, 1.04), (0.62, 0.86), (0.56, 0.70), (0.66, 0.62), (0.90, 0.68), (0.99, 0.84)),
    ((0.98, 0.98), (0.54, 0.84), (0.50, 0.74), (0.88, 0.70), (0.99, 0.82)),
    ((0.96, 1.02), (0.63, 0.95), (0.60, 0.66), (0.90, 0.62), (0.98, 0.78)),
    ((0.97, 1.12), (0.78, 1.00), (0.62, 0.66), (0.76, 0.55), (0.94, 0.66), (0.99, 0.86)),
    ((0.92, 0.98), (0.74, 1.00), (0.64, 0.86), (0.66, 0.66), (0.80, 0.58), (0.94, 0.68), (0.97, 0.86)),
    ((0.98, 1.06), (0.80, 0.98), (0.52, 0.80), (0.55, 0.68), (0.72, 0.74), (0.97, 0.82)),
)


@dataclass(frozen=True)
class _Face:
    """Where things lie on a front: half its width, its foot and its upper edge, metres above the road."""

    half: float
    foot: float
    top: float

    def at(self, points: Points, side: int = 1) -> NDArray[np.float64]:
        """Points in shares of the half-width and of the face's height, as a drawing's."""
        return np.array(mirrored([(y * self.half, self.z(t)) for y, t in points], side))

    def z(self, share: float) -> float:
        return self.foot + share * (self.top - self.foot)


def draw_front(skin: Skin, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool) -> None:
    """Screen, bonnet edge, lamps, grille, bumper and plate."""
    half = shape.width / 2
    face = _Face(half, shape.clearance + 0.08, face_edge(shape)[1])
    sill = shape.clearance + SILL + style.cladding
    dam = sill + rng.uniform(0.0, 0.05)
    ring = [(-half, 0), (half, 0), (half, sill), (0.8 * half, dam), (-0.8 * half, dam), (-half, sill)]
    skin.polygon(Chart.FRONT, ring, TRIM, MATTE)
    if style.dark_bumpers:
        skin.rectangle(Chart.FRONT, (-half, 0), (half, face.z(0.56)), TRIM, MATTE)
    _sheet_metal(skin, face, rng)
    _windscreen(skin, shape, style, rng)
    _mouths(skin, face, style, paint, rng)
    _head_lamps(skin, shape, face, style, float(np.mean(paint)), rng, lamps)
    edge = face.at([(-0.62, 0.97), (-0.3, 0.995), (0.3, 0.995), (0.62, 0.97)])
    skin.line(Chart.FRONT, edge, dim(paint, 0.4), PAINT, 0.012)
    skin.shadow(Chart.FRONT, edge, 0.3)
    plate(skin, Chart.FRONT, (0, face.z(rng.uniform(0.34, 0.46))), style.plate, rng)


def _sheet_metal(skin: Skin, face: _Face, rng: np.random.Generator) -> None:
    """Round the bumper and what stands above it from top to bottom; a ledge between, hollows at its corners."""
    ledge = rng.uniform(0.5, 0.62)
    bumper = face.at([(-1, 0), (1, 0), (1, ledge), (-1, ledge)])
    skin.bow(Chart.FRONT, bumper, (0.0, rng.uniform(2.0, 3.6)), (0.0, 0.05))
    above = face.at([(-1, ledge), (1, ledge), (1, 1.05), (-1, 1.05)])
    skin.bow(Chart.FRONT, above, (0.0, rng.uniform(0.6, 1.8)), (0.0, 0.05))
    rise = rng.uniform(0.0, 0.08)
    line = face.at([(-0.98, ledge + rise), (-0.5, ledge), (0.5, ledge), (0.98, ledge + rise)])
    skin.emboss(Chart.FRONT, [*line, *face.at([(1, 0), (-1, 0)])], 0.022, soft=True)
    skin.shadow(Chart.FRONT, line, rng.uniform(0.1, 0.3), 0.05)
    skin.shadow(Chart.FRONT, face.at([(-1, 0.02), (1, 0.02)]), 0.45, 0.10)


def _windscreen(skin: Skin, shape: Shape, style: Style, rng: np.random.Generator) -> None:
    half = shape.width / 2
    foot, head = shape.cowl[1], shape.roof_front[1] - 0.03
    low, high = cabin_edge(shape, half, foot) - 0.06, cabin_edge(shape, half, head) - 0.08
    ring = [(-low, foot), (low, foot), (high, head), (-high, head)]
    inner = pane(skin, Chart.FRONT, ring, style.glass)
    placed = on_screen([(0.95 * y, foot + 0.03) for y in (-low, low)], [(y, head - 0.03) for y in (-high, high)])
    behind_windscreen(skin, Chart.FRONT, placed, style.glass, style.clear, rng)
    gleam(skin, Chart.FRONT, inner, rng, rng.uniform(0.4, 0.9))


def _mouths(skin: Skin, face: _Face, style: Style, paint: Colour, rng: np.random.Generator) -> None:
    """Grille, intake and the hollows of fog lamps."""
    # Light comes into the openings, and bars stand in them that hardly part from what lies behind.
    hollow = rng.uniform(0.010, 0.026)
    dark: Colour = (hollow, hollow, 1.04 * hollow)
    bars, bright = rng.uniform(1.2, 2.2), dim(CHROME_TONE, rng.uniform(0.5, 0.9))

    def opening(points: Points, *, slats: bool = True, frame: bool = False) -> None:
        ring = face.at(points)
        smooth = rounded(ring, 0.10)
        skin.polygon(Chart.FRONT, smooth, dark, MATTE)
        skin.emboss(Chart.FRONT, smooth, -0.015)
        low, high = ring[:, 1].min(), ring[:, 1].max()
        reach = 0.8 * np.abs(ring[:, 0]).max()
        if slats:
            for z in np.arange(low + 0.03, high - 0.015, rng.uniform(0.035, 0.06)).tolist():
                skin.line(Chart.FRONT, [(-reach, z), (reach, z)], dim(dark, bars), MATTE)
        if frame and style.chrome:
            skin.line(Chart.FRONT, np.concatenate([smooth, smooth[:1]]), bright, LAMP, 0.016)

    wide, low = rng.uniform(0.46, 0.56), rng.uniform(0.08, 0.14)
    high = low + rng.uniform(0.16, 0.28)
    lower = [(-0.5, low), (0.5, low), (0.66, high - 0.06), (0.60, high), (-0.60, high), (-0.66, high - 0.06)]
    family, badge = style.grille, 0.84
    if family == 0:  # a bar between the lamps, a wide intake below
        opening([(-wide, 0.70), (wide, 0.70), (wide + 0.04, 0.92), (-wide - 0.04, 0.92)], frame=True)
        opening(lower)
        badge = 0.81
    elif family == 1:  # one tall frame through the bumper
        opening([(-0.30, 0.16), (0.30, 0.16), (0.42, 0.60), (0.38, 0.94), (-0.38, 0.94), (-0.42, 0.60)], frame=True)
        badge = 0.82
    elif family == 2:  # two openings side by side
        for side in (-1, 1):
            pair = [(side * y, t) for y, t in ((0.04, 0.68), (0.34, 0.70), (0.38, 0.88), (0.30, 0.93), (0.04, 0.92))]
            opening(pair, frame=True)
        opening(lower)
        badge = 0.98
    elif family == 3:  # a shield with a bright V around its badge
        opening([(-0.24, 0.52), (0.24, 0.52), (0.50, 0.90), (-0.50, 0.90)])
        skin.line(Chart.FRONT, face.at([(-0.38, 0.92), (-0.20, 0.56), (0.20, 0.56), (0.38, 0.92)]), bright, LAMP, 0.03)
        opening(lower)
        badge = 0.76
    elif family == 4:  # a slot above, a big mouth below
        opening([(-wide, 0.84), (wide, 0.84), (wide, 0.93), (-wide, 0.93)], slats=False)
        opening([(-0.44, low), (0.44, low), (0.62, 0.34), (0.50, 0.60), (-0.50, 0.60), (-0.62, 0.34)], frame=True)
        badge = 0.95
    elif family == 5:  # nearly closed
        skin.emboss(Chart.FRONT, rounded(face.at([(-0.4, 0.66), (0.4, 0.66), (0.46, 0.92), (-0.46, 0.92)])), -0.012)
        opening(lower)
    else:  # a dark band with the lamps at its ends
        skin.polygon(Chart.FRONT, face.at([(-0.7, 0.70), (0.7, 0.70), (0.7, 0.94), (-0.7, 0.94)]), dark, PAINT)
        if style.chrome:
            skin.line(Chart.FRONT, face.at([(-0.6, 0.72), (0.6, 0.72)]), bright, LAMP, 0.02)
        opening(lower)
        badge = 0.83
    if rng.random() < 0.55:
        _pods(skin, face, dark, low, rng)
    size = rng.uniform(0.034, 0.050)
    skin.circle(Chart.FRONT, (0, face.z(badge)), size, dim(CHROME_TONE, rng.uniform(0.4, 0.8)), LAMP)
    skin.circle(Chart.FRONT, (0, face.z(badge)), 0.5 * size, dim(CHROME_TONE, 0.2), PAINT)


def _pods(skin: Skin, face: _Face, dark: Colour, low: float, rng: np.random.Generator) -> None:
    """The bumper's corners: dark hollows, most with a fog lamp, some with a strip of light or chrome."""
    kind, tall = int(rng.choice(4, p=[0.35, 0.3, 0.2, 0.15])), rng.uniform(0.18, 0.30)
    for side in (-1, 1):
        ring = face.at([(0.68, low), (0.93, low + 0.04), (0.95, low + tall), (0.72, low + 0.7 * tall)], side)
        if kind < 3:
            skin.polygon(Chart.FRONT, rounded(ring), dark, MATTE)
            skin.emboss(Chart.FRONT, rounded(ring), -0.012)
        centre = ring.mean(axis=0)
        if kind in (0, 3):
            skin.circle(Chart.FRONT, centre.tolist(), 0.042, dim(_REFLECTOR, 0.7), LAMP)
            skin.circle(Chart.FRONT, centre.tolist(), 0.02, (0.14, 0.14, 0.15), LAMP)
        elif kind == 2:
            strip = face.at([(0.72, low + 0.7 * tall), (0.94, low + 0.95 * tall)], side)
            skin.line(Chart.FRONT, strip, dim(_REFLECTOR, 1.2), LAMP, 0.022)


def _head_lamps(
    skin: Skin, shape: Shape, face: _Face, style: Style, paint_level: float, rng: np.random.Generator, lamps: bool
) -> None:
    # Their inner ends reach inwards by more or less.
    longer = rng.uniform(1.0, 1.25)
    points = [(0.98 - longer * (0.98 - y), 0.82 + 1.3 * (t - 0.82)) for y, t in _HEAD_LAMPS[style.lamp]]
    # Some are silver all over, some dark; those that part from the paint show.
    low, high = (0.04, 0.13) if paint_level > 0.3 else (0.3, 0.7)
    shine = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    glass: Colour = (shine, 1.01 * shine, 1.03 * shine)
    depth = rng.uniform(0.2, 0.75)
    bowls, day_light = rng.random() < 0.55, rng.random() < 0.25
    for side in (-1, 1):
        ring = face.at(points, side)
        smooth, middle = rounded(ring, 0.10), ring.mean(axis=0)
        skin.polygon(Chart.FRONT, smooth, dim(glass, 0.35), LAMP)
        inner = middle + 0.9 * (smooth - middle)
        skin.polygon(Chart.FRONT, inner, glass, LAMP)
        skin.fade(Chart.FRONT, inner, dim(glass, 0.3), (0.0, 0.6))
        # The part beside the grille is darker than the bowls at the outer end.
        hidden = middle + np.array([0.7, 0.75]) * (smooth - middle) - np.array([side * 0.07 * face.half, 0.0])
        skin.fade(Chart.FRONT, hidden, (0.03, 0.03, 0.032), (depth, depth))
        skin.bow(Chart.FRONT, smooth, (1.0, 1.2), (0.0, 0.35))
        tall = float(np.ptp(smooth[:, 1]))
        for along, up, share in ((0.10, 0.02, 0.34), (-0.12, -0.04, 0.26)):
            spot = (float(middle[0]) + side * along * face.half, float(middle[1]) + up * tall)
            size = min(share * tall, 0.055)
            # Beside pale paint what shines as pale as it would tear the lamp apart.
            inside = dim(_REFLECTOR, 0.45 if paint_level > 0.3 else 1.0) if bowls else dim(glass, 0.5)
            skin.circle(Chart.FRONT, spot, 1.25 * size, inside, LAMP)
            skin.circle(Chart.FRONT, (spot[0], spot[1] - 0.5 * size), 0.6 * size, dim(inside, 0.6), LAMP)
            spark = (spot[0], spot[1] + 0.4 * size)
            skin.circle(Chart.FRONT, spark, (0.35 if paint_level > 0.3 else 0.55) * size, dim(_REFLECTOR, 1.6), LAMP)
            if lamps and along > 0:
                skin.circle(Chart.FRONT, spot, 0.055, GLOW, LIT)
        if day_light:
            # Daytime running lights burn by day, too: a strip along the lamp's foot.
            foot = middle + 0.75 * (ring[np.argsort(ring[:, 1])[:2]] - middle)
            skin.line(Chart.FRONT, foot, dim(GLOW, 0.75), LIT, 0.018)
        _wing_part(skin, shape, face, side, dim(glass, 0.8), points)


def _wing_part(skin: Skin, shape: Shape, face: _Face, side: int, glass: Colour, points: Points) -> None:
    """What of a head lamp lies on the wing, seen from above and from the side."""
    edge = face_edge(shape)[0]
    inner = min(y for y, _ in points)
    sweep = 0.06 + 0.5 * max(max(t for _, t in points) - 0.94, 0.0)
    ys = np.array([0.55 * inner + 0.45, 0.98, 0.98]) * face.half
    back = np.array([0.0, sweep, -0.14])
    on_top = np.stack([edge + setback(shape, edge, ys) + back, side * ys], axis=1)
    skin.polygon(Chart.TOP, on_top, glass, LAMP)
    skin.shadow(Chart.TOP, np.concatenate([on_top, on_top[:1]]), 0.25, 0.025)
    if side > 0:
        start = float(setback(shape, 0.0, 0.9 * face.half))
        low, high = min(t for y, t in points if y > 0.85), max(t for _, t in points)
        ring = [(0, face.z(low)), (0, face.z(high) + 0.02), (start + 0.28, face.z(high) + 0.02)]
        skin.polygon(Chart.SIDE, [*ring, (start + 0.12, face.z(low) + 0.03)], glass, LAMP)
