"""Meshes of vehicle bodies, from the proportions in `body_types`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.vehicle.body_types import Shape
from labelgen.synth.vehicle.mesh import Chart, Mesh, box_mesh, join, loft, tube_mesh, wheel_mesh

__all__ = ["END_M", "body_mesh", "cabin_edge", "face_edge", "outside_parts", "setback", "shell_end", "top_line"]

_FINE = 0.01
END_M = 0.18
"""Depth over which noses and tails show the charts FRONT and REAR, metres; a station of the loft."""
_AROUND_CORNERS = 0.3
"""Least cosine between a normal and the x axis for these charts."""


def shell_end(shape: Shape) -> float:
    """Return d, metres, where the lofted shell ends: at the tail, or behind the cab of a lorry."""
    return shape.length if shape.cargo is None else shape.rear_window[0] + 0.05


def face_edge(shape: Shape) -> tuple[float, float]:
    """Return (d, z), metres, at the centre line where the front's face meets the bonnet."""
    return 0.5 * _nose_reach(shape), shape.nose - 0.05


def _nose_reach(shape: Shape) -> float:
    return min(0.30, shape.cowl[0] * 0.6)


def top_line(shape: Shape) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return d and z, (N,) metres each, of the body's upper outline at its centre line, every centimetre."""
    end = shell_end(shape)
    roof_middle = (shape.roof_front[0] + shape.roof_rear[0]) / 2
    roof = shape.height if shape.cargo is None else shape.roof_rear[1] + 0.05
    drop, rise = roof - shape.roof_front[1], shape.cowl[1] - shape.nose
    long = roof_middle - shape.roof_front[0]
    reach = _nose_reach(shape)
    knots = [
        (0.0, shape.nose - 0.28),
        (0.2 * reach, shape.nose - 0.17),
        face_edge(shape),
        (reach, shape.nose),
        # A bonnet bulges.
        *((reach + t * (shape.cowl[0] - reach), shape.nose + rise * (1 - (1 - t) ** 1.55)) for t in (0.3, 0.6, 0.85)),
        shape.cowl,
        shape.roof_front,
        # A roof is an arc.
        *((shape.roof_front[0] + t * long, roof - drop * (1 - t) ** 2) for t in (0.2, 0.45, 0.7)),
        (roof_middle, roof),
        (0.5 * (roof_middle + shape.roof_rear[0]), roof - 0.25 * (roof - shape.roof_rear[1])),
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


def setback(shape: Shape, d: Any, y: Any) -> Any:
    """Return by how much, metres, a point at y lies behind the centre line: ends and screens are round in plan."""
    return _bow(shape, d) * np.square(y)


def _bow(shape: Shape, d: Any) -> NDArray[np.float64]:
    """Return the body's curvature in plan at d, 1 / m; negative towards the rear."""
    end = shell_end(shape)
    nose, tail = shape.round_nose, 0.0 if shape.cargo is not None else shape.round_tail
    roof_middle = (shape.roof_front[0] + shape.roof_rear[0]) / 2
    at = [0.0, shape.cowl[0], shape.roof_front[0], roof_middle, shape.roof_rear[0], shape.rear_window[0], end]
    rounds = [nose, 0.75 * nose, 0.45 * nose, 0.0, -0.45 * tail, -0.8 * tail, -tail]
    bow: NDArray[np.float64] = np.interp(d, at, rounds) / (shape.width / 2) ** 2
    return bow


def cabin_edge(shape: Shape, half_width: Any, z: Any) -> Any:
    """Return the half-width, metres, at a height z above the belt, where windows lean inwards."""
    up = np.maximum(z - shape.belt, 0)
    return 0.93 * half_width - shape.tumble * (up + 0.2 * up**2)


def _stations(shape: Shape) -> NDArray[np.float64]:
    end = shell_end(shape)
    marks = [shape.cowl[0], shape.roof_front[0], shape.roof_rear[0], shape.rear_window[0]]
    ends = [0, 0.02, 0.05, 0.1, END_M, 0.3, 0.45, 0.65]
    d = [*ends, *(end - e for e in ends), *np.arange(0.8, end - 0.7, 0.3)]
    d += [m + o for m in marks for o in (-0.16, -0.08, -0.03, 0.03, 0.08, 0.16)]
    ordered = np.unique(np.round(np.clip(d, 0, end), 3))
    return np.asarray(ordered[np.r_[True, np.diff(ordered) > 0.012]])


def _sections(columns: list[tuple[Any, Any]]) -> NDArray[np.float64]:
    """(S, K, 2) sections for `loft` from K lines along the body, each y and z at S stations."""
    return np.stack([np.stack(column, axis=1) for column in columns], axis=1)


def _shell(shape: Shape) -> Mesh:
    d = _stations(shape)
    z_top = np.interp(d, *top_line(shape))
    end = shell_end(shape)
    half = _half_width(shape, d)
    low = shape.clearance + 0.10 * np.clip(1 - d / 0.4, 0, 1) + 0.10 * np.clip(1 - (end - d) / 0.4, 0, 1)
    middle = np.minimum(shape.clearance + 0.38, z_top - 0.12)
    shoulder = np.minimum(shape.belt - 0.03, z_top - 0.08)
    above = np.maximum(z_top - 0.05 - shoulder, 0)
    # Roofs are arched across, and round at their edges where they stand well above the belt; so are bonnets.
    crown = np.minimum(0.045, 0.02 + 0.05 * above) if shape.cargo is None and shape.kind != "bus" else 0.0 * d
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
        (0.99 * half, 0.5 * (middle + shoulder)),
        (0.955 * half, shoulder),
        (0.925 * half, shoulder + np.minimum(0.035, 0.4 * (z_top - shoulder))),
        (edge, z_top - 0.035 - 1.1 * crown),
        (0.6 * edge + 0.4 * inner, z_top - 0.018 - 0.75 * crown),
        (inner, z_top - 0.008 - 0.5 * crown),
        (0.5 * inner, z_top - 0.12 * crown),
        (np.zeros_like(d), z_top),
    ]
    return _drawings_of_ends(shape, loft(shape.length / 2 - d, _sections(columns), bow=_bow(shape, d)))


def _drawings_of_ends(shape: Shape, shell: Mesh) -> Mesh:
    """Assign charts to screens, nose and tail.

    A screen of about 45 degrees would show parts of two charts, so each takes one. Nose and tail show FRONT and REAR
    around their corners and up to the lids, so that lamps are not cut.
    """
    middles = shell.vertices[shell.triangles].mean(axis=1)
    d = shape.length / 2 - middles[:, 0]
    d -= setback(shape, d, middles[:, 1])
    normals = shell.normals.mean(axis=1)
    charts = shell.charts.copy()
    for upper, lower, end in (
        (shape.roof_front, shape.cowl, Chart.FRONT),
        (shape.roof_rear, shape.rear_window, Chart.REAR),
    ):
        steep = upper[1] - lower[1] > abs(upper[0] - lower[0])
        first, last = sorted((upper[0], lower[0]))
        here = (d > first) & (d < last) & (middles[:, 2] > shape.belt) & (charts != Chart.SIDE) & (normals[:, 2] > -0.1)
        charts[here] = end if steep else Chart.TOP
    facing = np.abs(normals[:, 0]) > _AROUND_CORNERS
    # Except cabs over their engines, whose screens begin nearer to the front.
    if shape.cowl[0] > END_M:
        charts[facing & (d < END_M)] = Chart.FRONT
    if shape.cargo is None:
        charts[facing & (d > shell_end(shape) - END_M)] = Chart.REAR
    return replace(shell, charts=charts)


def outside_parts(shape: Shape) -> list[Mesh]:
    """Return the meshes of wing mirrors and aerial in the frame of `body_mesh`.

    They are rendered, but belong neither to the body's cuboid nor to its mask.
    """
    if shape.cargo is not None or shape.kind == "bus":
        # Tall ones on arms beside the screen.
        x, y, z = shape.length / 2 - 0.12, shape.width / 2, shape.cowl[1] + (0.25 if shape.cargo is not None else 1.0)
        housings = [[(x, side * (y + 0.13), z + up) for up in (0.0, 0.1, 0.5, 0.62)] for side in (1, -1)]
        arms = [[(x - 0.1, side * (y + out), z + 0.55) for out in (-0.12, 0.0, 0.1)] for side in (1, -1)]
        return [
            *(tube_mesh(spine, (0.05, 0.1, 0.1, 0.05), chart=Chart.MIRROR, sides=8) for spine in housings),
            *(tube_mesh(spine, (0.03, 0.03, 0.03), chart=Chart.MIRROR, sides=6) for spine in arms),
        ]
    d = shape.cowl[0] + 0.36 * (shape.roof_front[0] - shape.cowl[0]) + 0.06
    x, half, z = shape.length / 2 - d, shape.width / 2, shape.belt + (0.10 if shape.kind == "van" else 0.045)
    thick = 0.12 if shape.kind == "van" else 0.08
    # Across: foot, inner end, middle and outer end of the housing, which leans back a little. In a coarse picture a
    # thinner foot would vanish.
    across = (-0.13, -0.05, 0.0, 0.06, 0.10)
    radii = (0.05, 0.055, 0.85 * thick, thick, 0.7 * thick)
    spines = [[(x - 0.3 * max(y, 0), side * (half + y), z + 0.2 * y) for y in across] for side in (1, -1)]
    parts = [tube_mesh(spine, radii, chart=Chart.MIRROR, sides=8, flat=0.75) for spine in spines]
    if shape.aerial is not None:
        foot, z = shape.length / 2 - shape.aerial, float(np.interp(shape.aerial, *top_line(shape))) - 0.02
        whip = [(foot - 0.25 * up, 0.0, z + up) for up in (0.0, 0.17, 0.34)]
        parts.append(tube_mesh(whip, (0.007, 0.005, 0.004), chart=Chart.DARK, sides=4))
    return parts


def _underneath(shape: Shape, low: float, high: float) -> list[Mesh]:
    """Return side guards below a lorry's load, and the wind deflector on its cab."""
    assert shape.cargo is not None
    half, middle = shape.width / 2, shape.length / 2
    gaps = zip(shape.axles[:-1], shape.axles[1:], strict=True)
    first, last = max(gaps, key=lambda gap: gap[1] - gap[0])
    first = max(first + 0.7, shape.cargo[0] + 0.3)
    parts = [
        box_mesh((middle - last + 0.75, y - 0.04, 0.45), (middle - first, y + 0.04, low))
        for y in (-0.90 * half, 0.90 * half)
    ]
    roof = shape.roof_rear[1]
    if high - roof > 0.2:
        start, end = shape.roof_front[0] + 0.25, shape.roof_rear[0] - 0.05
        d = np.linspace(start, end, 6)
        top = roof + (high - 0.05 - roof) * np.sin(np.linspace(0.05, 1, 6) * np.pi / 2)
        wide = np.full_like(d, 0.86 * half)
        foot, none = np.full_like(d, roof - 0.1), np.zeros_like(d)
        columns = [(none, foot), (wide, foot), (wide, top - 0.06), (wide - 0.1, top), (none, top)]
        parts.append(loft(middle - d, _sections(columns)))
    return parts


def _roof_unit(shape: Shape, place: tuple[float, float, float, float]) -> Mesh:
    """Return a housing on a bus's roof, round at its edges."""
    start, long, wide, tall = place
    d = start + long * np.array([0.0, 0.03, 0.1, 0.9, 0.97, 1.0])
    foot = np.interp(d, *top_line(shape)) - 0.06
    top = foot + 0.06 + tall * np.array([0.3, 0.75, 1.0, 1.0, 0.75, 0.3])
    half, none = np.full_like(d, wide / 2), np.zeros_like(d)
    columns = [(none, foot), (half, foot), (half, top - 0.35 * tall), (0.88 * half, top - 0.05 * tall), (none, top)]
    return loft(shape.length / 2 - d, _sections(columns))


def body_mesh(shape: Shape) -> Mesh:
    """Return the mesh of a vehicle; its bounding cuboid stands on z = 0, centred at x = y = 0."""
    half = shape.width / 2
    parts = [_shell(shape)]
    for d in shape.axles:
        for side in (1, -1):
            parts.append(wheel_mesh(shape.length / 2 - d, 0.985 * half, shape.wheel, 0.24, side))
    if shape.cargo is not None:
        start, low, high = shape.cargo
        front, rear = shape.length / 2 - start, -shape.length / 2
        parts.append(box_mesh((rear, -half, low), (front, half, high)))
        parts.append(box_mesh((rear + 0.1, -0.4 * half, 0.55), (front + 0.5, 0.4 * half, low), chart=Chart.DARK))
        parts.append(box_mesh((rear + 0.15, -0.55 * half, 0.6), (rear + 0.7, 0.55 * half, low), chart=Chart.DARK))
        parts.append(box_mesh((rear + 0.02, -0.94 * half, 0.45), (rear + 0.12, 0.94 * half, 0.62), chart=Chart.REAR))
        parts += _underneath(shape, low, high)
    if shape.roof_unit is not None:
        parts.append(_roof_unit(shape, shape.roof_unit))
    mesh = join(parts)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    shift = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return Mesh(mesh.vertices - shift, mesh.triangles, mesh.normals, mesh.charts)
