"""A few common vehicles as sets of points whose convex hull is the body: what the scale is measured with.

The forms are those of the synthetic renderer in their mean proportions: what a hatchback, a saloon or a van looks like
on average. Vehicles of a type differ in length, width and height, and a mask says little about each of them; that is
what `SIZE_SPREAD` allows for. `python -m tools.studies.common_bodies` makes their file.
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
"""Standard deviations of the length, width and height of the vehicles of one type, in shares."""
COMMON_KINDS = ("supermini", "hatchback", "saloon", "estate", "suv", "minivan", "van")
"""The types that make up most of European traffic. Lorries and buses vary too much in size to measure with."""
BODIES_FILE = "common_bodies.json"
"""Each type's share in traffic, and the corners of its hull, millimetres."""


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
    """One body of each common type."""
    kept = json.loads(Path(__file__).with_name(BODIES_FILE).read_text(encoding="utf-8"))
    total = sum(kept[kind]["share"] for kind in COMMON_KINDS)
    return tuple(
        Body(kind, kept[kind]["share"] / total, np.array(kept[kind]["corners_mm"]) / 1000.0) for kind in COMMON_KINDS
    )
