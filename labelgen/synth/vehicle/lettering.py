"""Lettering of companies on lorries and vans."""

from __future__ import annotations

import numpy as np

from labelgen.synth.shading.materials import PAINT
from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.mesh import Chart
from labelgen.synth.vehicle.texture import Colour, Texture

__all__ = ["TRADES", "company_name", "letter_cargo", "letter_colour", "letter_van", "telephone"]

# Both sides of a vehicle show one drawing, mirrored on the right: these letters and digits are symmetric.
_DIGITS = "018"
_SYLLABLES = ("MA", "TO", "VI", "HA", "XI", "YO", "TU", "WA", "AM", "OT", "IVA", "OHM")
_ROOM_M = 1.2
"""Length of a van's side without windows below which it carries no lettering, metres."""
TRADES = ("TRANSPORT", "CARGO", "EXPRESS", "LOGISTIK", "FREIGHT", "FRESH", "SPEDITION", "MOVERS", "PAPIER", "BAU")


def company_name(rng: np.random.Generator) -> str:
    """Sample the name of a company."""
    return "".join(rng.choice(_SYLLABLES, int(rng.integers(2, 4))))


def telephone(rng: np.random.Generator, digits: str = "0123456789") -> str:
    """Sample a telephone number from the given digits."""
    return " ".join("".join(rng.choice(list(digits), 3)) for _ in range(3))


def letter_colour(rng: np.random.Generator) -> Colour:
    """Sample a faded colour for letters and bands."""
    bright = rng.uniform(0.01, 0.6, 3) ** 1.3
    red, green, blue = (0.4 * bright + 0.6 * bright.mean()).tolist()
    return red, green, blue


def letter_cargo(texture: Texture, shape: Shape, start: float, rng: np.random.Generator) -> None:
    """Paint a company's name and number on the sides and the back of a cargo body that begins at d = `start`."""
    assert shape.cargo is not None
    if rng.random() < 0.1:
        return
    _, low, high = shape.cargo
    tall, long = high - low, shape.length - start
    colour, left = letter_colour(rng), start + rng.uniform(0.08, 0.3) * long
    if rng.random() < 0.4:
        band = (start, low + 0.1), (shape.length, low + rng.uniform(0.25, 0.5) * tall)
        texture.rectangle(Chart.SIDE, *band, letter_colour(rng), PAINT)
    base, size = low + rng.uniform(0.4, 0.6) * tall, rng.uniform(0.12, 0.28) * tall
    name = company_name(rng)
    size = min(size, 0.9 * (shape.length - 0.3 - left) / len(name))
    texture.text(Chart.SIDE, (left, base), name, size, colour, PAINT)
    if rng.random() < 0.8:
        half = shape.width / 2
        if rng.random() < 0.5:
            name = f"{name} {rng.choice(TRADES)}"
        size = min(rng.uniform(0.16, 0.34), 1.7 * half / len(name))
        at, foot = -0.5 * size * len(name), low + rng.uniform(0.45, 0.75) * tall
        texture.text(Chart.REAR, (max(at, -0.9 * half), foot), name, size, colour, PAINT)
        if rng.random() < 0.6:
            texture.text(Chart.REAR, (-0.7 * half, foot - 0.5 * size - 0.12), telephone(rng), 0.09, colour, PAINT)


def letter_van(texture: Texture, shape: Shape, first: float, rng: np.random.Generator) -> None:
    """Paint a name and a number on a van's doors, and on its sides where there is room.

    Args:
        texture: of the van.
        shape: of the van.
        first: d, metres, where its side windows end.
        rng: gives the texts and their places.
    """
    colour, name = letter_colour(rng), company_name(rng)
    size = min(rng.uniform(0.2, 0.4), 0.7 / len(name))
    texture.text(Chart.REAR, (-0.75, 0.85), name, size, colour, PAINT)
    texture.text(Chart.REAR, (0.12, 0.80), telephone(rng), 0.07, colour, PAINT)
    room = shape.length - 0.3 - first
    if room < _ROOM_M:
        return
    if rng.random() < 0.3:  # above the wheels' arches
        edge = [(first, 0.86), (shape.length, 0.86), (shape.length, shape.belt + 0.1)]
        texture.polygon(Chart.SIDE, edge, letter_colour(rng), PAINT)
    size = min(rng.uniform(0.2, 0.4), 0.85 * room / len(name))
    base = shape.belt + rng.uniform(0.1, 0.35)
    texture.text(Chart.SIDE, (first + 0.1 * room, base), name, size, colour, PAINT)
    texture.text(Chart.SIDE, (first + 0.1 * room, base - 0.22), telephone(rng, _DIGITS), 0.1, colour, PAINT)
