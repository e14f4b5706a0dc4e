"""Write the bodies of common vehicles that the calibration uses, from the synthetic renderer's.

    python -m tools.studies.common_bodies

Writes labelgen/geometry/common_bodies.json, because building the meshes takes seconds. A test fails when the file is
out of date.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import typer

from labelgen.atomic_files import write_atomic
from labelgen.geometry import vehicle_bodies as bodies
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import BODIES_FILE, COMMON_KINDS
from labelgen.synth.vehicle.body_mesh import body_mesh, outside_parts
from labelgen.synth.vehicle.body_types import BODY_TYPES, mean_shape

__all__ = ["corners", "main"]

_DIRECTIONS = 3000
"""Directions in which hull and body are compared."""
_TOLERANCE_M = 0.01
"""Largest difference in any of them, metres; a smaller one needs more corners, which cost time in the fit."""
_MIRROR_M = 0.05
"""How far wing mirrors stand out in silhouettes, metres: less than in fact, since they are thin."""


def corners(kind: str) -> Array:
    """Return corners (V, 3) m of a body's hull, few of them, that reach as far as the body in any direction."""
    shape = mean_shape(kind)
    reach = shape.width / 2 + _MIRROR_M
    mirrors = np.concatenate([part.vertices for part in outside_parts(shape)])
    mirrors[:, 1] = mirrors[:, 1].clip(-reach, reach)
    points = np.concatenate([body_mesh(shape).vertices, mirrors])
    # Directions spread evenly over the sphere.
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / _DIRECTIONS, np.pi * (1 + 5**0.5) * k
    spread = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    reaches = points @ np.concatenate([spread, np.eye(3), -np.eye(3)], axis=1)
    farthest = reaches.max(axis=0)
    selected = [int(reaches[:, 0].argmax())]
    while True:
        short = farthest - reaches[selected].max(axis=0)
        worst = int(short.argmax())
        if short[worst] <= _TOLERANCE_M:
            return np.asarray(points[selected])
        selected.append(int(reaches[:, worst].argmax()))


def main() -> None:
    """Write the file."""
    types = {
        kind: {"share": BODY_TYPES[kind].share, "corners_mm": np.rint(1000 * corners(kind)).astype(int).tolist()}
        for kind in COMMON_KINDS
    }
    rows = [f'"{kind}": {json.dumps(body)}' for kind, body in types.items()]
    path = Path(bodies.__file__).with_name(BODIES_FILE)
    write_atomic(path, ("{\n" + ",\n".join(rows) + "\n}\n").encode())
    typer.echo(str(path))


if __name__ == "__main__":
    typer.run(main)
