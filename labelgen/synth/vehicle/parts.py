"""Parts that all vehicles have: style, number plates, wheels, windows and reflectors of lamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.materials import GLASS, LAMP, MATTE, PLATE
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.front_designs import CAR_DESIGNS, VAN_DESIGNS, FrontDesign
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.tail_lamp_designs import CAR_TAILS, VAN_TAILS, TailDesign
from labelgen.synth.vehicle.texture import Colour, Texture, dim, rounded

__all__ = [
    "BLACK",
    "CHROME_TONE",
    "GLOW",
    "PLATES",
    "SEAM",
    "SILL",
    "SKY",
    "TRIM",
    "Style",
    "draw_dashboard_reflection",
    "draw_plate",
    "draw_reflector",
    "draw_sky_reflection",
    "draw_wheels",
    "draw_window",
    "mirrored",
    "sample_style",
]

BLACK: Colour = (0.010, 0.010, 0.011)
TRIM: Colour = (0.045, 0.045, 0.047)
SILL = 0.05
"""Height of the dark edge below a body's paint where there is no cladding, metres."""
CHROME_TONE: Colour = (0.50, 0.50, 0.51)
GLOW: Colour = (1.0, 0.97, 0.88)
"""Colour of head lamps that are on."""
SEAM = 0.5
"""Brightness of a gap between panels, as a share of the paint's."""


@dataclass(frozen=True)
class Style:
    """Design of a vehicle beyond its proportions.

    Args:
        front: its lamps, grille and bumper.
        tail: its tail lamps.
        cladding: height of unpainted plastic at the sills, metres; also around the wheels when over 0.1.
        dark_bumpers: whether bumpers are unpainted.
        chrome: whether window frames and the bar above the rear plate are bright.
        glass: albedo of the dark behind the glass.
        rear_glass: the same from the second row on.
        clear, rear_clear: 0 to 1, light that comes through the cabin to the windscreen, to the rear window.
        dark_roof: whether the roof is black.
        rails: 0 none, 1 black, 2 bright.
        plate: index into `PLATES`.
        plate_high: whether the rear plate sits on the boot lid rather than the bumper.
    """

    front: FrontDesign
    tail: TailDesign
    cladding: float
    dark_bumpers: bool
    chrome: bool
    glass: Colour
    rear_glass: Colour
    clear: float
    rear_clear: float
    dark_roof: bool
    rails: int
    plate: int
    plate_high: bool


PLATES = ("european", "yellow", "blue", "short")
"""Families of number plates: white with a blue strip; yellow; blue with white letters; short and white."""


def sample_style(shape: Shape, rng: np.random.Generator, plates: str | None = None) -> Style:
    """Sample a style that suits a body; `plates` is one of `PLATES`, any when None."""
    rugged = shape.kind in ("suv", "pickup", "van") and rng.random() < 0.6
    dark = rng.uniform(0.008, 0.022)
    private = rng.random() < (0.5 if shape.kind in ("suv", "minivan", "estate") else 0.25)
    clear = rng.uniform(0.15, 1.0)
    behind = 0.006 if private else dark
    upright = shape.bed is not None or (shape.kind in ("suv", "minivan", "estate", "van") and rng.random() < 0.5)
    rails = 0
    if shape.kind in ("estate", "suv", "minivan"):
        rails = int(rng.choice(3, p=[0.64, 0.14, 0.22]))
    designs = VAN_DESIGNS if shape.kind == "van" else CAR_DESIGNS
    shares = np.array([design.share for design in designs])
    tails = VAN_TAILS if shape.kind == "van" else CAR_TAILS
    tail_shares = np.array([design.upright if upright else design.wide for design in tails])
    family = int(rng.choice(len(PLATES), p=[0.55, 0.15, 0.15, 0.15]))
    return Style(
        front=designs[int(rng.choice(len(designs), p=shares / shares.sum()))],
        tail=tails[int(rng.choice(len(tails), p=tail_shares / tail_shares.sum()))],
        cladding=rng.uniform(0.12, 0.2) if rugged else rng.uniform(0.0, 0.07),
        dark_bumpers=bool(rng.random() < (0.5 if shape.kind in ("van", "lorry", "articulated") else 0.06)),
        chrome=bool(rng.random() < 0.14),
        glass=(0.85 * dark, 1.15 * dark, 1.15 * dark),
        rear_glass=(behind, behind * 1.1, behind * 1.1),
        clear=clear * (0.4 if private else 1.0),
        rear_clear=(0.2 if private else rng.uniform(0.35, 1.0)) * clear,
        dark_roof=bool(rng.random() < 0.05) and shape.kind not in ("van", "lorry", "articulated", "bus"),
        rails=rails,
        plate=family if plates is None else PLATES.index(plates),
        plate_high=bool(rng.random() < 0.6),
    )


_INK: Colour = (0.05, 0.05, 0.048)
_PLATES: tuple[tuple[Colour, Colour, bool], ...] = (
    ((0.62, 0.62, 0.60), _INK, True), ((0.43, 0.32, 0.075), _INK, True),
    ((0.15, 0.24, 0.33), (0.56, 0.58, 0.59), False), ((0.60, 0.60, 0.58), (0.07, 0.09, 0.22), False),
)  # fmt: skip
"""Colours of ground and letters, and whether there is a blue strip on the left."""


_DUST: Colour = (0.20, 0.19, 0.17)
SKY: Colour = (0.30, 0.33, 0.36)
"""Colour of the sky that bright glass reflects."""


def _toward(colour: Colour, other: Colour, share: float) -> Colour:
    red, green, blue = (a + share * (b - a) for a, b in zip(colour, other, strict=True))
    return red, green, blue


def draw_plate(
    texture: Texture, chart: Chart, centre: tuple[float, float], family: int, rng: np.random.Generator
) -> None:
    """Paint a number plate in its frame; `family` is an index into `PLATES`."""
    y, z = centre
    ground, ink, strip = _PLATES[family]
    half, tall = (0.26, 0.055) if family < 2 else (0.21, 0.07)
    worn = rng.uniform(0.0, 0.2)
    ground, ink = _toward(ground, _DUST, 0.6 * worn), _toward(ink, ground, 0.1 + worn)
    recess = [(y - half, z + tall), (y + half, z + tall), (y + half, z - tall), (y - half, z - tall)]
    texture.flatten(chart, recess)
    texture.shadow(chart, [*recess, recess[0]], 0.3, 0.05)
    texture.rectangle(chart, (y - half - 0.012, z - tall - 0.012), (y + half + 0.012, z + tall + 0.012), TRIM, MATTE)
    texture.rectangle(chart, (y - half, z - tall), (y + half, z + tall), ground, PLATE)
    if strip:
        texture.rectangle(chart, (y - half, z - tall), (y - half + 0.035, z + tall), (0.03, 0.06, 0.24), PLATE)
    for k in range(7):
        if k == 3:
            continue
        left, wide, high = y + half * (-0.72 + 0.23 * k), 0.036, 0.56 * tall
        for _ in range(int(rng.integers(2, 4))):  # strokes
            if rng.random() < 0.5:
                at = left + rng.uniform(0, wide - 0.012)
                texture.rectangle(chart, (at, z - high), (at + 0.012, z + high), ink, PLATE)
            else:
                at = z + rng.uniform(-high, high - 0.012)
                texture.rectangle(chart, (left, at), (left + wide, at + 0.014), ink, PLATE)
    # Its upper part reflects the sky.
    texture.fade(chart, recess, SKY, (rng.uniform(0.05, 0.25), 0.03))


def draw_window(
    texture: Texture, chart: Chart, corners: Any, glass: Colour, *, rim: float = 0.96
) -> NDArray[np.float64]:
    """Paint a window with rounded corners and a black rim; return the outline (N, 2) of its glass."""
    ring = np.asarray(corners, dtype=np.float64)
    smooth, middle = rounded(ring, 0.11), ring.mean(axis=0)
    texture.polygon(chart, smooth, BLACK, GLASS)
    inner = middle + rim * (smooth - middle)
    texture.polygon(chart, inner, glass, GLASS)
    texture.groove(chart, np.concatenate([smooth, smooth[:1]]), 0.003, 0.02)
    texture.shadow(chart, np.concatenate([smooth, smooth[:1]]), 0.35, 0.04)
    # Glass is curved across: its middle reflects the sky, its sides the roadside.
    texture.bow(chart, smooth, (0.2, 0.42) if chart is Chart.TOP else (0.42, 0.45))
    return np.asarray(inner)


def draw_dashboard_reflection(texture: Texture, chart: Chart, ring: Any, rng: np.random.Generator) -> None:
    """Paint the dashboard's reflection in a windscreen: a pale veil, mostly stronger at its foot."""
    points, level = np.asarray(ring, dtype=np.float64), rng.uniform(0.05, 0.17)
    tone: Colour = (0.72 * level, level, 0.95 * level)
    shares = (rng.uniform(0.0, 0.3), rng.uniform(0.1, 0.7))  # at the head, at the foot
    # On chart TOP the front lies on the left.
    texture.fade(chart, points, tone, shares[::-1] if chart is Chart.TOP else shares, level=chart is Chart.TOP)


def draw_sky_reflection(
    texture: Texture, chart: Chart, ring: Any, rng: np.random.Generator, share: float = 0.5
) -> None:
    """Paint the reflection of the sky on glass, which fades from its upper edge downwards.

    On chart TOP the ring starts with the window's lower edge.
    """
    points = np.asarray(ring, dtype=np.float64)
    top, foot = share * rng.uniform(0.6, 1.3), 0.06 * share
    tone: Colour = (0.18, 0.21, 0.225)
    if chart is not Chart.TOP:
        texture.fade(chart, points, tone, (top, foot))
        return
    n = len(points) // 2
    rises = points[n:, 0].mean() > points[:n, 0].mean()
    texture.fade(chart, points, tone, (foot, top) if rises else (top, foot), level=True)


def draw_wheels(texture: Texture, shape: Shape, rng: np.random.Generator) -> None:
    """Paint tyres, rims of one of four families, and hubs."""
    texture.fill(Chart.WHEEL, (0.016, 0.016, 0.016), MATTE)
    family = int(rng.integers(4))
    bright = float(rng.choice([0.04, 0.16, 0.30, 0.42], p=[0.15, 0.25, 0.35, 0.25]))
    rim: Colour = (bright, bright, bright * 1.03)
    spokes = int(rng.integers(5, 11))
    heavy = shape.wheel > 0.42
    for axle in shape.axles:
        hub = np.array([axle, shape.wheel])
        outer = (0.55 if heavy else 0.70) * shape.wheel
        texture.circle(Chart.WHEEL, hub.tolist(), outer + 0.02, rim, LAMP)
        texture.circle(Chart.WHEEL, hub.tolist(), outer - 0.01, (0.012, 0.012, 0.012), MATTE)
        if family == 0 or heavy:
            texture.circle(Chart.WHEEL, hub.tolist(), 0.85 * outer, dim(rim, 0.7), MATTE)
        else:
            wide = (0.0, 0.10, 0.17, 0.25)[family]
            for k in range(spokes if family != 3 else 5):
                angle = 2 * np.pi * k / (spokes if family != 3 else 5) + axle
                ahead = np.array([np.cos(angle), np.sin(angle)])
                across = np.array([-ahead[1], ahead[0]]) * wide * shape.wheel
                tip = hub + 0.98 * outer * ahead
                ring = [hub - across, hub + across, tip + 0.7 * across, tip - 0.7 * across]
                texture.polygon(Chart.WHEEL, ring, rim, LAMP)
        texture.circle(Chart.WHEEL, hub.tolist(), 0.16 * shape.wheel, rim, LAMP)


def draw_reflector(
    texture: Texture, chart: Chart, centre: NDArray[np.float64], radius: float, tones: tuple[Colour, Colour, Colour]
) -> None:
    """Paint a round reflector in three tones: its rim, its inside, and a highlight above its centre."""
    rim, inside, spot = tones
    texture.circle(chart, centre.tolist(), radius, rim, LAMP)
    texture.circle(chart, centre.tolist(), 0.74 * radius, inside, LAMP)
    texture.circle(chart, (centre + np.array([0, 0.27 * radius])).tolist(), 0.34 * radius, spot, LAMP)


def mirrored(points: Sequence[tuple[float, float]], side: int) -> list[tuple[float, float]]:
    """Return points of the left half (side 1) or mirrored to the right half (side -1) of an end view."""
    return [(side * y, z) for y, z in points]
