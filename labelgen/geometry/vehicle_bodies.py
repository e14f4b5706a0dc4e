"""Convex bodies of common vehicle types, with which the scale and contact points are measured.

The shapes are those of the synthetic renderer in their mean proportions. `SIZE_SPREAD` states how the vehicles of one
type differ from them. `python -m tools.studies.common_bodies` writes their file.

Convention:
    Points are (V, 3) float64 metres: x ahead, y to the left, z up, from the middle of the vehicle's floor.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from labelgen.geometry.homography import Array

__all__ = ["BODIES_FILE", "COMMON_KINDS", "SIZE_SPREAD", "Body", "common_bodies"]

SIZE_SPREAD = (0.06, 0.03, 0.04)
"""Standard deviations of length, width and height within one type, as shares of the mean."""
COMMON_KINDS = ("supermini", "hatchback", "saloon", "estate", "suv", "minivan", "van")
"""The types that make up most of European traffic. Lorries and buses are left out: their sizes vary too much."""
BODIES_FILE = "common_bodies.json"
"""JSON file with each type's share in traffic and the corners of its convex hull in millimetres."""


@dataclass(frozen=True, eq=False)
class Body:
    """The mean body of a common vehicle type.

    Args:
        kind: name of the type.
        share: its share in traffic among the types used here; all shares sum to 1.
        points: (V, 3) metres, corners of its convex hull, wing mirrors included, as in silhouettes.
    """

    kind: str
    share: float
    points: Array


@cache
def common_bodies() -> tuple[Body, ...]:
    """Return one body of each common type."""
    bodies = json.loads(Path(__file__).with_name(BODIES_FILE).read_text(encoding="utf-8"))
    total = sum(bodies[kind]["share"] for kind in COMMON_KINDS)
    return tuple(
        Body(kind, bodies[kind]["share"] / total, np.array(bodies[kind]["corners_mm"]) / 1000.0)
        for kind in COMMON_KINDS
    )
