"""Paint fronts of cars and vans from `front_designs`: screens, lamps, grilles, intakes, bumpers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.materials import LAMP, LIT, MATTE, PAINT
from labelgen.synth.vehicle.body_mesh import END_M, cabin_edge, face_edge, setback
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.front_designs import FrontDesign, Opening
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.paint_interior import draw_behind_windscreen, screen_coordinates
from labelgen.synth.vehicle.parts import (
    CHROME_TONE,
    GLOW,
    SEAM,
    SILL,
    SKY,
    TRIM,
    Style,
    draw_dashboard_reflection,
    draw_plate,
    draw_reflector,
    draw_sky_reflection,
    draw_window,
    mirrored,
)
from labelgen.synth.vehicle.texture import Colour, Texture, dim, rounded

__all__ = ["draw_front"]

_REFLECTOR: Colour = (0.55, 0.56, 0.57)
_GAP: Colour = (0.012, 0.012, 0.013)
"""Colour of the gap between a lamp and the paint."""
_PALE = 0.3
"""Mean albedo from which paint counts as pale."""
Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class _Face:
    """Coordinates on a front: half its width, and its foot and upper edge, metres above the road."""

    half: float
    foot: float
    top: float

    def at(self, points: Points, side: int = 1) -> NDArray[np.float64]:
        """Return (N, 2) metres of points in shares of the half-width and of the face's height."""
        return np.array(mirrored([(y * self.half, self.z(t)) for y, t in points], side))

    def z(self, share: float) -> float:
        return self.foot + share * (self.top - self.foot)


def draw_front(
    texture: Texture, shape: Shape, paint: Colour, style: Style, rng: np.random.Generator, lamps: bool
) -> None:
    """Paint screen, bonnet edge, lamps, grille, bumper and plate."""
    half, design = shape.width / 2, style.front
    face = _Face(half * rng.uniform(0.97, 1.01), shape.clearance + 0.08, face_edge(shape)[1] + rng.uniform(-0.01, 0.02))
    sill = max(shape.clearance + SILL + style.cladding, face.z(design.lip))
    dam = sill + rng.uniform(0.0, 0.05)
    if style.dark_bumpers:
        texture.rectangle(Chart.FRONT, (-half, 0), (half, face.z(0.56)), TRIM, MATTE)
    _sheet_metal(texture, face, rng)
    texture.polygon(
        Chart.FRONT,
        [(-half, 0), (half, 0), (half, sill), (0.8 * half, dam), (-0.8 * half, dam), (-half, sill)],
        TRIM,
        MATTE,
    )
    _windscreen(texture, shape, style, rng)
    _openings(texture, face, design, paint, rng)
    _head_lamps(texture, shape, face, design, float(np.mean(paint)), rng, lamps)
    edge = face.at([(-0.62, 0.97), (-0.3, 0.995), (0.3, 0.995), (0.62, 0.97)])
    texture.line(Chart.FRONT, edge, dim(paint, SEAM), PAINT, 0.012)
    texture.shadow(Chart.FRONT, edge, 0.15)
    draw_plate(texture, Chart.FRONT, (0, face.z(design.plate + rng.uniform(-0.03, 0.03))), style.plate, rng)


def _sheet_metal(texture: Texture, face: _Face, rng: np.random.Generator) -> None:
    """Curve the bumper and the panel above it, with a ledge between them."""
    ledge = rng.uniform(0.5, 0.62)
    bumper = face.at([(-1, 0), (1, 0), (1, ledge), (-1, ledge)])
    texture.bow(Chart.FRONT, bumper, (0.0, rng.uniform(2.0, 3.6)), (0.0, 0.05))
    above = face.at([(-1, ledge), (1, ledge), (1, 1.05), (-1, 1.05)])
    texture.bow(Chart.FRONT, above, (0.0, rng.uniform(0.6, 1.8)), (0.0, 0.05))
    rise = rng.uniform(0.0, 0.08)
    line = face.at([(-0.98, ledge + rise), (-0.5, ledge), (0.5, ledge), (0.98, ledge + rise)])
    texture.emboss(Chart.FRONT, [*line, *face.at([(1, 0), (-1, 0)])], 0.022, soft=True)
    texture.shadow(Chart.FRONT, line, rng.uniform(0.1, 0.3), 0.05)
    texture.shadow(Chart.FRONT, face.at([(-1, 0.02), (1, 0.02)]), 0.45, 0.10)


def _windscreen(texture: Texture, shape: Shape, style: Style, rng: np.random.Generator) -> None:
    half = shape.width / 2
    foot, head = shape.cowl[1], shape.roof_front[1] - 0.03
    low, high = cabin_edge(shape, half, foot) - 0.06, cabin_edge(shape, half, head) - 0.08
    ring = [(-low, foot), (low, foot), (high, head), (-high, head)]
    inner = draw_window(texture, Chart.FRONT, ring, style.glass)
    placed = screen_coordinates(
        [(0.95 * y, foot + 0.03) for y in (-low, low)], [(y, head - 0.03) for y in (-high, high)]
    )
    draw_behind_windscreen(texture, Chart.FRONT, placed, style.glass, style.clear, rng)
    draw_sky_reflection(texture, Chart.FRONT, inner, rng, rng.uniform(0.4, 0.9))
    draw_dashboard_reflection(texture, Chart.FRONT, inner, rng)


def _openings(texture: Texture, face: _Face, design: FrontDesign, paint: Colour, rng: np.random.Generator) -> None:
    """Paint grille, intakes, the bumper's corners, chrome and the badge."""
    # Some light enters the openings; their bars differ little from what lies behind.
    hollow = rng.uniform(0.012, 0.034)
    dark: Colour = (hollow, hollow, 1.04 * hollow)
    bright = dim(CHROME_TONE, rng.uniform(0.45, 1.1))
    rims, bars = rng.random() < 0.5, rng.uniform(1.6, 3.5)
    strip = bool(design.hollow) and _corners(texture, face, design, dark, bright, rng)
    for opening in design.openings:
        rings = [face.at(opening.half, side) for side in (-1, 1)]
        if not opening.paired:
            rings = [np.concatenate([rings[1], rings[0][::-1]])]
        for ring in rings:
            _opening(texture, ring, opening, dark, dim(dark, bars), bright if rims else dark)
    if not strip:
        _fog_lamps(texture, face, design)
    low, high = design.skid
    if high > low and rng.random() < 0.7:
        ring = face.at([(-0.46, low), (0.46, low), (0.40, high), (-0.40, high)])
        texture.polygon(Chart.FRONT, ring, dim(_REFLECTOR, rng.uniform(0.3, 0.8)), LAMP)
    for lines, colour, material in ((design.painted, paint, PAINT), (design.bright, bright, LAMP)):
        for half, width in lines:
            for side in (-1, 1):
                texture.line(Chart.FRONT, face.at(half, side), colour, material, width)
    _badge(texture, face, design, bright, rng)


def _opening(
    texture: Texture, ring: NDArray[np.float64], opening: Opening, dark: Colour, bars: Colour, rim: Colour
) -> None:
    smooth = rounded(ring, 0.08)
    closed = np.concatenate([smooth, smooth[:1]])
    texture.polygon(Chart.FRONT, smooth, dark, MATTE)
    texture.emboss(Chart.FRONT, smooth, -0.02)
    (left, low), (right, high) = ring.min(axis=0), ring.max(axis=0)
    inset = 0.12 * (right - left)
    if opening.inside in ("slats", "mesh"):
        for z in np.arange(low + 0.03, high - 0.015, 0.035 if opening.inside == "mesh" else 0.05).tolist():
            texture.line(Chart.FRONT, [(left + inset, z), (right - inset, z)], bars, MATTE)
    if opening.inside in ("fins", "mesh"):
        for y in np.arange(left + inset, right - inset + 0.01, 0.045).tolist():
            texture.line(Chart.FRONT, [(y, low + 0.02), (y, high - 0.02)], bars, MATTE)
    if opening.rim:
        texture.line(Chart.FRONT, closed, rim, LAMP, opening.rim)
    # The frame's upper edge shades the opening.
    texture.shadow(Chart.FRONT, [(left + inset, high - 0.02), (right - inset, high - 0.02)], 0.5, 0.04)


def _corners(
    texture: Texture, face: _Face, design: FrontDesign, dark: Colour, bright: Colour, rng: np.random.Generator
) -> bool:
    """Paint dark hollows at the bumper's corners; return whether a light strip replaces the fog lamps."""
    kind = int(rng.choice(3, p=[0.6, 0.25, 0.15]))  # plain; with a bright frame; with a strip
    for side in (-1, 1):
        ring = rounded(face.at(design.hollow, side), 0.1)
        texture.polygon(Chart.FRONT, ring, dark, MATTE)
        texture.emboss(Chart.FRONT, ring, -0.015)
        if kind == 1:
            under = ring[np.argsort(ring[:, 1])[: len(ring) // 2]]
            under = under[np.argsort(under[:, 0])]
            texture.line(Chart.FRONT, under, bright, LAMP, 0.022)
        elif kind == 2:
            texture.line(Chart.FRONT, face.at(design.hollow[1:3], side), dim(_REFLECTOR, 1.2), LAMP, 0.024)
    return kind == 2


def _fog_lamps(texture: Texture, face: _Face, design: FrontDesign) -> None:
    for side in (-1, 1):
        for y, t, radius in design.fog:
            centre = face.at([(y, t)], side)[0]
            draw_reflector(
                texture, Chart.FRONT, centre, radius, (dim(_REFLECTOR, 0.75), (0.10, 0.10, 0.11), _REFLECTOR)
            )


def _badge(texture: Texture, face: _Face, design: FrontDesign, bright: Colour, rng: np.random.Generator) -> None:
    t, size, form = design.badge
    z, size = face.z(t), size * rng.uniform(0.9, 1.1)
    if form == "none":
        return
    if form == "bolt":
        for share, colour in ((1.0, bright), (0.55, dim(bright, 0.12))):
            wide, tall = 0.75 * share * size, 1.1 * share * size
            texture.polygon(Chart.FRONT, [(-wide, z), (0, z - tall), (wide, z), (0, z + tall)], colour, LAMP)
        return
    texture.circle(Chart.FRONT, (0, z), size, bright, LAMP)
    texture.circle(Chart.FRONT, (0, z), 0.72 * size, dim(bright, 0.15 if form == "ring" else 0.4), LAMP)
    if form == "ring":
        texture.line(Chart.FRONT, [(-0.7 * size, z), (0.7 * size, z)], bright, LAMP, 0.018)


def _head_lamps(
    texture: Texture,
    shape: Shape,
    face: _Face,
    design: FrontDesign,
    paint_level: float,
    rng: np.random.Generator,
    lamps: bool,
) -> None:
    """Paint head lamps: a black or silver housing with reflectors, strips and indicator, and a gap around."""
    # On pale cars silver housings would hardly show, so they are darker.
    pale = paint_level > _PALE
    black = rng.random() < (0.4 + 0.6 * design.dark if pale else design.dark)
    level = rng.uniform(0.012, 0.04) if black else rng.uniform(0.08, 0.22) if pale else rng.uniform(0.16, 0.42)
    housing: Colour = (level, 1.01 * level, 1.03 * level)
    silver = dim(_REFLECTOR, rng.uniform(0.9, 1.3))
    day_light, sky = rng.random() < 0.15, rng.uniform(0.06, 0.2)
    for side in (-1, 1):
        ring = face.at(design.lamp, side)
        smooth, middle = rounded(ring, 0.08), ring.mean(axis=0)
        closed = np.concatenate([smooth, smooth[:1]])
        texture.polygon(Chart.FRONT, smooth, housing, LAMP)
        if not black:  # its foot and the part beside the grille are darker
            texture.fade(Chart.FRONT, smooth, dim(housing, 0.25), (0.0, 0.75))
            inner = middle + np.array([0.75, 0.85]) * (smooth - middle) - np.array([side * 0.06 * face.half, 0.0])
            texture.fade(Chart.FRONT, inner, (0.03, 0.03, 0.032), (0.35, 0.45))
        if design.amber:
            tone: Colour = (0.30, 0.115, 0.02) if not pale or not black else (0.16, 0.06, 0.012)
            texture.polygon(Chart.FRONT, rounded(face.at(design.amber, side), 0.08), tone, LAMP)
        for k, (y, t, radius) in enumerate(design.bowls):
            centre = face.at([(y, t)], side)[0]
            inside = dim(silver, 0.22 if black else 0.45)
            draw_reflector(texture, Chart.FRONT, centre, radius, (dim(silver, 0.7), inside, dim(silver, 1.2)))
            if lamps and k == 0:
                texture.circle(Chart.FRONT, centre.tolist(), 1.05 * radius, GLOW, LIT)
        for strip in design.strips:
            lit: tuple[Colour, int] = (dim(GLOW, 0.75), LIT) if day_light else (dim(silver, 1.1), LAMP)
            texture.line(Chart.FRONT, face.at(strip, side), *lit, width=0.016)
        texture.fade(Chart.FRONT, smooth, SKY, (sky, 0.0))
        texture.line(Chart.FRONT, closed, _GAP, LAMP, 0.012)
        texture.bow(Chart.FRONT, smooth, (0.8, 1.0), (0.0, 0.30))
        texture.emboss(Chart.FRONT, smooth, 0.006)
        _wing_part(texture, shape, face, side, design, housing)


def _wing_part(texture: Texture, shape: Shape, face: _Face, side: int, design: FrontDesign, housing: Colour) -> None:
    """Paint the part of a head lamp that lies on the wing, on top and side."""
    inner = min(y for y, t in design.lamp if t > 0.9)
    ys = np.array([0.5 * inner + 0.5, 0.99, 0.97, 0.90]) * face.half
    back = np.array([-0.01, -0.02, 0.6 * design.sweep, 0.35 * design.sweep])
    on_top = np.stack([END_M + setback(shape, END_M, ys) + back, side * ys], axis=1)
    smooth = rounded(on_top, 0.08)
    texture.polygon(Chart.TOP, smooth, _GAP, LAMP)
    middle = on_top.mean(axis=0)
    texture.polygon(Chart.TOP, middle + 0.8 * (smooth - middle), dim(housing, 0.8), LAMP)
    if side > 0:
        start = float(setback(shape, 0.0, 0.9 * face.half))
        low, high = min(t for y, t in design.lamp if y > 0.85), max(t for _, t in design.lamp)
        tip = start + 0.16 + design.sweep
        ring = [
            (0, face.z(low)),
            (0, face.z(high) + 0.02),
            (tip, face.z(high) + 0.03),
            (start + 0.14, face.z(low) + 0.03),
        ]
        texture.polygon(Chart.SIDE, ring, dim(housing, 0.9), LAMP)
        texture.line(Chart.SIDE, [*ring, ring[0]], _GAP, LAMP, 0.012)
