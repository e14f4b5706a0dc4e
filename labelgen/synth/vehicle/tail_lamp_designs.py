"""Designs of tail lamps: outlines, fields, reflectors and strips.

Points are (y, down): y in shares of the half-width from the middle outwards, down in shares of the lamp's height below
its top, negative above it. Each describes one side. None is of a particular make.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CAR_TAILS", "VAN_TAILS", "TailDesign"]

Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class TailDesign:
    """One family of tail lamps.

    Args:
        outline: of the glass.
        clear: the reversing lamp; empty without.
        amber: the indicator, orange or smoky; empty without.
        bowls: y, down and the radius in metres of round lamps behind the glass.
        strips: bright lines, of light guides or trim.
        wide, upright: how common it is on bodies with a low boot, and on those with a tall tailgate.
    """

    outline: Points
    clear: Points = ()
    amber: Points = ()
    bowls: tuple[tuple[float, float, float], ...] = ()
    strips: tuple[Points, ...] = ()
    wide: float = 0.0
    upright: float = 0.0


CAR_TAILS: tuple[TailDesign, ...] = (
    TailDesign(  # a wedge that points inwards
        outline=((1.0, -0.05), (0.66, 0.05), (0.56, 0.35), (0.68, 0.85), (1.0, 1.0)),
        clear=((0.62, 0.50), (0.76, 0.48), (0.78, 0.80), (0.69, 0.80)),
        amber=((0.78, 0.48), (0.96, 0.46), (0.98, 0.90), (0.80, 0.80)),
        strips=(((0.62, 0.30), (0.98, 0.16)),), wide=0.20, upright=0.05,
    ),
    TailDesign(  # upright, beside the window
        outline=((1.0, -0.8), (0.90, -0.85), (0.79, -0.3), (0.79, 0.75), (0.88, 1.0), (1.0, 1.0)),
        clear=((0.82, 0.42), (0.98, 0.42), (0.98, 0.66), (0.82, 0.66)),
        amber=((0.82, 0.16), (0.98, 0.16), (0.98, 0.40), (0.82, 0.40)),
        bowls=((0.90, -0.2, 0.05),), wide=0.08, upright=0.30,
    ),
    TailDesign(  # long and lying
        outline=((1.0, -0.1), (0.52, 0.12), (0.44, 0.45), (0.60, 0.75), (1.0, 0.95)),
        clear=((0.52, 0.34), (0.66, 0.32), (0.66, 0.60), (0.58, 0.60)),
        bowls=((0.76, 0.44, 0.045), (0.90, 0.44, 0.045)),
        strips=(((0.54, 0.66), (0.98, 0.84)),), wide=0.18,
    ),
    TailDesign(  # upright with a foot that reaches inwards
        outline=((1.0, -0.9), (0.91, -0.95), (0.85, -0.1), (0.58, 0.25), (0.62, 0.75), (1.0, 1.0)),
        clear=((0.66, 0.42), (0.80, 0.36), (0.82, 0.68), (0.68, 0.66)),
        amber=((0.88, -0.1), (0.98, -0.14), (0.98, 0.16), (0.87, 0.16)),
        strips=(((0.94, -0.8), (0.93, 0.1), (0.68, 0.34)),), wide=0.10, upright=0.20,
    ),
    TailDesign(  # a plain block in three fields
        outline=((1.0, 0.0), (0.70, 0.0), (0.68, 0.95), (1.0, 1.0)),
        clear=((0.71, 0.40), (0.84, 0.40), (0.84, 0.62), (0.71, 0.62)),
        amber=((0.86, 0.40), (0.99, 0.40), (0.99, 0.64), (0.86, 0.64)),
        wide=0.14, upright=0.10,
    ),
    TailDesign(  # two round lamps
        outline=((1.0, -0.05), (0.66, 0.0), (0.60, 0.5), (0.66, 0.96), (1.0, 1.0)),
        clear=((0.70, 0.80), (0.84, 0.80), (0.84, 0.92), (0.70, 0.92)),
        bowls=((0.73, 0.42, 0.062), (0.90, 0.42, 0.062)),
        wide=0.14, upright=0.10,
    ),
    TailDesign(  # an L lying on its side
        outline=((1.0, -0.1), (0.50, 0.05), (0.50, 0.42), (0.74, 0.52), (0.78, 1.0), (1.0, 1.0)),
        clear=((0.54, 0.18), (0.68, 0.14), (0.68, 0.36), (0.54, 0.34)),
        strips=(((0.56, 0.12), (0.98, 0.02), (0.98, 0.9)), ((0.72, 0.4), (0.94, 0.44), (0.94, 0.8))),
        wide=0.14, upright=0.05,
    ),
    TailDesign(  # high and small, with clear glass
        outline=((1.0, -1.0), (0.87, -1.0), (0.76, -0.5), (0.75, 0.3), (0.84, 0.5), (1.0, 0.5)),
        clear=((0.78, -0.35), (0.99, -0.35), (0.99, 0.05), (0.78, 0.05)),
        bowls=((0.87, -0.55, 0.045), (0.86, 0.24, 0.045)),
        upright=0.20,
    ),
)  # fmt: skip

VAN_TAILS: tuple[TailDesign, ...] = (
    TailDesign(
        outline=((1.0, -0.5), (0.90, -0.5), (0.885, 0.6), (0.90, 1.2), (1.0, 1.2)),
        clear=((0.90, 0.5), (0.99, 0.5), (0.99, 0.8), (0.90, 0.8)),
        amber=((0.90, -0.42), (0.99, -0.42), (0.99, -0.05), (0.90, -0.05)),
        wide=0.5, upright=0.5,
    ),
    TailDesign(
        outline=((1.0, -0.1), (0.84, -0.1), (0.84, 0.9), (1.0, 0.9)),
        clear=((0.86, 0.55), (0.99, 0.55), (0.99, 0.8), (0.86, 0.8)),
        amber=((0.86, 0.0), (0.99, 0.0), (0.99, 0.25), (0.86, 0.25)),
        wide=0.5, upright=0.5,
    ),
)  # fmt: skip
