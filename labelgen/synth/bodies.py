"""Vehicle bodies as meshes, from the proportions of `shapes`."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.mesh import Chart, Mesh, box_mesh, join, loft, tube_mesh, wheel_mesh
from labelgen.synth.shapes import Shape

__all__ = ["MIRROR", "body_mesh", "cabin_edge", "shell_end", "top_line", "wing_mirrors"]

MIRROR = 0.01
"""How far a wing mirror stands out from the body, metres."""
_FINE = 0.01


def shell_end(shape: Shape) -> float:
    """Where the lofted shell ends, metres behind the front: at the tail, or behind the cab of a lorry."""
    return shape.length if shape.cargo is None else shape.rear_window[0] + 0.05


def top_line(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The body's upper outline in side view: d and z, every centimetre, rounded as sheet metal is."""
    end = shell_end(shape)
    roof_middle = (shape.roof_front[0] + shape.roof_rear[0]) / 2
    roof = shape.height if shape.cargo is None else shape.roof_rear[1] + 0.05
    knots = [
        (0.0, shape.nose - 0.22),
        (0.05, shape.nose - 0.10),
        (min(0.22, shape.cowl[0] * 0.6), shape.nose),
        (0.45 * shape.cowl[0] + 0.1, shape.nose + 0.55 * (shape.cowl[1] - shape.nose)),
        shape.cowl,
        shape.roof_front,
        (shape.roof_front[0] + 0.3 * (roof_middle - shape.roof_front[0]), roof - 0.02),
        (roof_middle, roof),
        shape.roof_rear,
        shape.rear_window,
        (end - 0.10, shape.tail),
        (end, shape.tail - 0.16),
    ]
    knots = [k for i, k in enumerate(knots) if i == 0 or k[0] > knots[i - 1][0]]
    d = np.arange(0, end + _FINE / 2, _FINE)
    z: Any = np.interp(d, *np.array(knots).T)
    pad = 30
    smooth: Any = cv2.GaussianBlur(np.pad(z, pad, mode="edge")[None], (0, 0), 4.5)[0, pad:-pad]
    return d, smooth


def _half_width(shape: Shape, d: NDArray[Any]) -> NDArray[np.float64]:
    end = shell_end(shape)
    front = np.clip(1 - d / 0.75, 0, 1)
    rear = np.clip(1 - (end - d) / 0.55, 0, 1) if shape.cargo is None else np.zeros_like(d)
    corner = np.clip(1 - d / 0.12, 0, 1) ** 2 * 0.05 + np.clip(1 - (end - d) / 0.08, 0, 1) ** 2 * 0.04
    narrow = shape.corner * front**2.2 + 0.6 * shape.corner * rear**2.2 + corner
    return shape.width / 2 * (1 - narrow)


def cabin_edge(shape: Shape, half_width: Any, z: Any) -> Any:
    """Half-width of the body at a height above the belt, where windows lean inwards."""
    return 0.93 * half_width - shape.tumble * np.maximum(z - shape.belt, 0)


def _stations(shape: Shape) -> NDArray[np.float64]:
    end = shell_end(shape)
    marks = [shape.cowl[0], shape.roof_front[0], shape.roof_rear[0], shape.rear_window[0]]
    ends = [0, 0.02, 0.05, 0.1, 0.18, 0.3, 0.45, 0.65]
    d = [*ends, *(end - e for e in ends), *np.arange(0.8, end - 0.7, 0.3)]
    d += [m + o for m in marks for o in (-0.16, -0.08, -0.03, 0.03, 0.08, 0.16)]
    ordered = np.unique(np.round(np.clip(d, 0, end), 3))
    return np.asarray(ordered[np.r_[True, np.diff(ordered) > 0.012]])


def _shell(shape: Shape) -> Mesh:
    d = _stations(shape)
    z_top = np.interp(d, *top_line(shape))
    end = shell_end(shape)
    half = _half_width(shape, d)
    low = shape.clearance + 0.10 * np.clip(1 - d / 0.4, 0, 1) + 0.10 * np.clip(1 - (end - d) / 0.4, 0, 1)
    middle = np.minimum(shape.clearance + 0.38, z_top - 0.12)
    shoulder = np.minimum(shape.belt - 0.03, z_top - 0.06)
    above = np.maximum(z_top - 0.05 - shoulder, 0)
    edge = cabin_edge(shape, half, z_top - 0.05)
    # Where there is no cabin the top curves over to the bonnet or boot lid.
    edge = np.minimum(edge, 0.93 * half - 0.03)
    inner = edge - np.minimum(0.11, 0.06 + 0.05 * above)
    columns = [
        (np.zeros_like(d), low),
        (0.80 * half, low),
        (0.955 * half, low + 0.05),
        (0.985 * half, low + 0.16),
        (half, middle),
        (0.992 * half, 0.5 * (middle + shoulder)),
        (0.965 * half, shoulder),
        (0.935 * half, shoulder + np.minimum(0.035, 0.5 * (z_top - shoulder))),
        (edge, z_top - 0.045),
        (inner, z_top - 0.012),
        (0.55 * inner, z_top - 0.003),
        (np.zeros_like(d), z_top),
    ]
    sections = np.stack([np.stack(c, axis=1) for c in columns], axis=1)
    return loft(shape.length / 2 - d, sections)


def _mirrors(shape: Shape) -> list[Mesh]:
    d = shape.cowl[0] + 0.42 * (shape.roof_front[0] - shape.cowl[0]) + 0.08
    x, out = shape.length / 2 - d, shape.width / 2
    tall = 0.10 if shape.cargo is None and shape.kind != "bus" else 0.35
    z = shape.belt + 0.02
    lows = [(x - 0.04, -out - MIRROR, z), (x - 0.04, out - 0.11, z)]
    return [box_mesh(low, (low[0] + 0.09, low[1] + MIRROR + 0.11, z + tall), chart=Chart.MIRROR) for low in lows]


def wing_mirrors(shape: Shape) -> list[Mesh]:
    """What of a car's wing mirrors stands out from its body, on a short foot; in the frame of `body_mesh`.

    They are drawn, but belong neither to the body's cuboid nor to its mask.
    """
    if shape.cargo is not None or shape.kind == "bus":
        return []
    d = shape.cowl[0] + 0.36 * (shape.roof_front[0] - shape.cowl[0]) + 0.06
    x, half, z = shape.length / 2 - d, shape.width / 2, shape.belt + (0.10 if shape.kind == "van" else 0.045)
    thick = 0.12 if shape.kind == "van" else 0.08
    # Across: foot, the housing's inner end, its middle, its outer end; it leans back a little. The foot is thick enough
    # for the housing not to float beside the body in a coarse picture.
    across = (-0.13, -0.06, -0.02, 0.065, 0.10)
    radii = (0.055, 0.05, 0.8 * thick, thick, 0.55 * thick)
    spines = [[(x - 0.3 * max(y, 0), side * (half + y), z + 0.2 * y) for y in across] for side in (1, -1)]
    return [tube_mesh(spine, radii, chart=Chart.MIRROR, sides=8) for spine in spines]


def body_mesh(shape: Shape) -> Mesh:
    """Mesh of a vehicle whose bounding cuboid stands on z = 0 around the origin."""
    half = shape.width / 2
    parts = [_shell(shape), *_mirrors(shape)]
    for d in shape.axles:
        for side in (1, -1):
            parts.append(wheel_mesh(shape.length / 2 - d, 0.985 * half, shape.wheel, 0.24, side))
    if shape.cargo is not None:
        start, low, high = shape.cargo
        front, rear = shape.length / 2 - start, -shape.length / 2
        parts.append(box_mesh((rear, -half, low), (front, half, high)))
        parts.append(box_mesh((rear + 0.1, -0.4 * half, 0.55), (front + 0.5, 0.4 * half, low), chart=Chart.DARK))
        parts.append(box_mesh((rear + 0.02, -0.9 * half, 0.45), (rear + 0.12, 0.9 * half, 0.62), chart=Chart.DARK))
    mesh = join(parts)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    shift = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return Mesh(mesh.vertices - shift, mesh.triangles, mesh.normals, mesh.charts)
