"""A few common vehicles as sets of points whose convex hull is the body: what the scale is measured with.

The forms are those of the synthetic renderer (`labelgen.synth.shapes`) in their mean proportions: what a hatchback, a
saloon or a van looks like on average. Vehicles of a type differ in length, width and height, and a mask says little
about each of them; that is what `SIZE_SPREAD` allows for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from labelgen.geometry.projective import Array
from labelgen.synth.bodies import body_mesh
from labelgen.synth.shapes import BODY_TYPES, mean_shape

__all__ = ["SIZE_SPREAD", "Body", "common_bodies"]

SIZE_SPREAD = (0.06, 0.03, 0.04)
"""Standard deviations of the length, width and height of the vehicles of one type, in shares."""
_COMMON = ("supermini", "hatchback", "saloon", "estate", "suv", "minivan", "van")
_DIRECTIONS, _SHORT_M = 3000, 0.01


@dataclass(frozen=True, eq=False)
class Body:
    """The body of a common type of vehicle.

    Args:
        kind: its name.
        share: how common it is among the types used here; they sum to 1.
        points: (V, 3) metres, x ahead, y left, z up, around the middle of its floor: corners of its convex hull. Its
            wing mirrors are among them, as they are in its silhouettes.
    """

    kind: str
    share: float
    points: Array


@cache
def common_bodies() -> tuple[Body, ...]:
    """The types that make up most of European traffic. Lorries and buses vary too much in size to measure with."""
    shares = np.array([BODY_TYPES[kind].share for kind in _COMMON])
    shares = shares / shares.sum()
    return tuple(Body(kind, float(share), _corners(kind)) for kind, share in zip(_COMMON, shares, strict=True))


def _corners(kind: str) -> Array:
    """The fewest corners of a body's hull that reach as far as it does in every direction, to a few millimetres."""
    points = body_mesh(mean_shape(kind)).vertices
    # Directions spread evenly over the sphere.
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + 5**0.5) * k
    spread = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    reaches = points @ np.concatenate([spread, np.eye(3), -np.eye(3)], axis=1)
    farthest = reaches.max(axis=0)
    chosen = [int(reaches[:, 0].argmax())]
    while True:
        short = farthest - reaches[chosen].max(axis=0)
        worst = int(short.argmax())
        if short[worst] <= _SHORT_M:
            return np.asarray(points[chosen])
        chosen.append(int(reaches[:, worst].argmax()))
