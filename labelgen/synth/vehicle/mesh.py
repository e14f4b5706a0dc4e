"""Triangle meshes in a vehicle's own frame: lofted shells, boxes and wheels.

Convention: metres; x ahead, y left, z up; triangles anticlockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["Chart", "Mesh", "box_mesh", "join", "loft", "tube_mesh", "wheel_mesh"]

_CAP_STEPS = 8


class Chart(IntEnum):
    """Drawings of the texture; each triangle shows one."""

    SIDE = 0
    TOP = 1
    FRONT = 2
    REAR = 3
    WHEEL = 4
    DARK = 5
    MIRROR = 6


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a normal per corner and a chart each.

    Args:
        vertices: (V, 3) float64 metres.
        triangles: (T, 3) int32.
        normals: (T, 3, 3) float32 unit normals at the corners.
        charts: (T,) uint8, `Chart`.
        extra: number of last triangles that are rendered but are no part of the body's mask and size: wing mirrors.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    normals: NDArray[np.float32]
    charts: NDArray[np.uint8]
    extra: int = 0

    @property
    def body(self) -> NDArray[np.int32]:
        """(B, 3) int32, the triangles of the body."""
        return self.triangles[: len(self.triangles) - self.extra]

    @cached_property
    def body_vertices(self) -> NDArray[np.int64]:
        """(N,) indices of the vertices of `body`."""
        return np.unique(self.body)


@numba.njit(cache=True, nogil=True)
def _corner_normals(
    unit: NDArray[Any], area_normals: NDArray[Any], order: NDArray[Any], starts: NDArray[Any], limit: float
) -> NDArray[Any]:
    """Return for each corner the area-weighted mean normal of the faces at its vertex that turn little from its own."""
    out = np.zeros((len(order), 3))
    for group in range(len(starts) - 1):
        for i in range(starts[group], starts[group + 1]):
            corner = order[i]
            own = corner // 3
            # Scalar sums, since array arithmetic takes seconds to compile.
            x, y, z = 0.0, 0.0, 0.0
            for j in range(starts[group], starts[group + 1]):
                face = order[j] // 3
                cosine = unit[own, 0] * unit[face, 0] + unit[own, 1] * unit[face, 1] + unit[own, 2] * unit[face, 2]
                if cosine > limit:
                    x += area_normals[face, 0]
                    y += area_normals[face, 1]
                    z += area_normals[face, 2]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            out[corner, 0], out[corner, 1], out[corner, 2] = x / length, y / length, z / length
    return out


def _with_normals(vertices: NDArray[Any], triangles: NDArray[Any], charts: NDArray[Any] | int, crease: float) -> Mesh:
    """Return a mesh whose corner normals average the faces at a vertex that turn less than `crease` degrees."""
    vertices = np.asarray(vertices, dtype=np.float64)
    triangles = np.asarray(triangles, dtype=np.int32)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    area_normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(area_normals, axis=1)
    keep = areas > 1e-9
    triangles, area_normals, areas = triangles[keep], area_normals[keep], areas[keep]
    kept_charts = np.broadcast_to(np.asarray(charts, dtype=np.uint8), len(keep))[keep].copy()
    unit = area_normals / areas[:, None]
    # Coincident vertices count as one, so that seams of a loft stay smooth.
    _, merged = np.unique(np.round(vertices, 4), axis=0, return_inverse=True)
    corner_vertex = merged.ravel()[triangles].ravel()
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(corner_vertex[order]) > 0, True])
    normals = _corner_normals(unit, area_normals, order, starts, float(np.cos(np.radians(crease))))
    return Mesh(vertices, triangles, normals.reshape(-1, 3, 3).astype(np.float32), kept_charts)


def _charts_by_normal(vertices: NDArray[Any], triangles: NDArray[Any]) -> NDArray[np.uint8]:
    """Return (T,) the chart that each face shows, by its normal."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    weight = np.stack([np.abs(normal[:, 1]), normal[:, 2], normal[:, 0], -normal[:, 0]], axis=1)
    charts = weight.argmax(axis=1).astype(np.uint8)
    down = -normal[:, 2] > np.abs(normal[:, :2]).max(axis=1)
    return np.where(down, np.uint8(Chart.DARK), charts)


def loft(
    x: Sequence[float] | NDArray[Any], sections: NDArray[Any], *, bow: Sequence[float] | NDArray[Any] | None = None,
    crease: float = 50.0,
) -> Mesh:  # fmt: skip
    """Return a closed shell through cross-sections, which are mirrored to the other side.

    Args:
        x: (S,) metres, falling: from the front to the rear.
        sections: (S, K, 2) metres, y >= 0 and z of the left half, from the centre of the floor over the side to the
            centre of the roof.
        bow: (S,) 1 / m; a section's points lie `bow * y**2` behind its centre, as noses and screens are round in
            plan; 0 when None.
        crease: degrees; edges that turn more stay sharp.
    """
    half = np.asarray(sections, dtype=np.float64)
    mirrored = half[:, -2:0:-1] * np.array([-1.0, 1.0])
    ring = np.concatenate([half, mirrored], axis=1)
    count, around = ring.shape[:2]
    middles = np.asarray(x, dtype=np.float64)
    bows = np.zeros(count) if bow is None else np.asarray(bow, dtype=np.float64)

    def placed(points: NDArray[Any], section: Any) -> NDArray[np.float64]:
        behind = bows[section, None] * points[..., 0] ** 2
        return np.concatenate([(middles[section, None] - behind)[..., None], points], axis=-1).reshape(-1, 3)

    vertices = [placed(ring, np.arange(count))]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    c, d = a + around, b + around
    triangles = [np.stack([a, b, d, a, d, c], axis=-1).reshape(-1, 3)[:, ::-1]]
    # End caps are strips from left to right, since sections need not be convex as a fan requires.
    across = np.linspace(1, -1, _CAP_STEPS + 1)
    rows = half.shape[1]
    k, m = np.meshgrid(np.arange(rows - 1), np.arange(_CAP_STEPS), indexing="ij")
    for section in (0, count - 1):
        start = sum(len(v) for v in vertices)
        grid = np.stack([half[section, :, :1] * across, np.broadcast_to(half[section, :, 1:], (rows, len(across)))], -1)
        vertices.append(placed(grid, np.array([section] * rows)))
        a = start + k * len(across) + m
        b, c, d = a + 1, a + len(across), a + len(across) + 1
        cap = np.stack([a, b, d, a, d, c], axis=-1).reshape(-1, 3)
        triangles.append(cap if section else cap[:, ::-1])
    corners, faces = np.concatenate(vertices), np.concatenate(triangles)
    return _with_normals(corners, faces, _charts_by_normal(corners, faces), crease)


def box_mesh(low: Sequence[float], high: Sequence[float], *, chart: Chart | None = None) -> Mesh:
    """Return an axis-aligned box between two corners (x, y, z), metres; charts by the faces' normals when None."""
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [1, 5, 7, 3], [0, 2, 6, 4]])
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    charts = _charts_by_normal(corners, triangles) if chart is None else int(chart)
    return _with_normals(corners, triangles, charts, 30.0)


def tube_mesh(
    spine: Sequence[Sequence[float]], radii: Sequence[float], *, chart: Chart | None = None, sides: int = 10,
    flat: float = 1.0,
) -> Mesh:  # fmt: skip
    """Return a closed round body along a polyline of three or more points: limbs, helmets, tanks.

    Args:
        spine: (S, 3) metres.
        radii: (S,) metres.
        chart: drawing that it shows; by the faces' normals when None.
        sides: corners of each ring.
        flat: ratio of its height to its width.
    """
    points = np.asarray(spine, dtype=np.float64)
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(along, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(along, across)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    ring = ring * [1.0, 1.0, flat]
    rings = points[:, None] + ring * np.asarray(radii, dtype=np.float64)[:, None, None]
    vertices = np.concatenate([rings.reshape(-1, 3), points[[0, -1]]])
    count = len(points)
    i, j = np.meshgrid(np.arange(count - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    around = np.stack([a, b, b + sides, a, b + sides, a + sides], axis=-1).reshape(-1, 3)
    k = np.arange(sides)
    first, last = count * sides, count * sides + 1
    start = np.stack([np.full(sides, first), (k + 1) % sides, k], axis=1)
    base = (count - 1) * sides
    end = np.stack([np.full(sides, last), base + k, base + (k + 1) % sides], axis=1)
    triangles = np.concatenate([around, start, end])
    charts = _charts_by_normal(vertices, triangles) if chart is None else int(chart)
    return _with_normals(vertices, triangles, charts, 60.0)


def wheel_mesh(x: float, y_out: float, radius: float, width: float, side: int, *, steps: int = 20) -> Mesh:
    """Return a wheel that stands on the road.

    Args:
        x: metres, of its axle.
        y_out: metres, distance of its outer face from the vehicle's middle.
        radius: metres.
        width: metres.
        side: +1 on the left, -1 on the right.
        steps: corners of its rim.
    """
    angle = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    ring = np.stack([x + radius * np.cos(angle), radius + radius * np.sin(angle)], axis=1)
    dish = np.stack([x + 0.9 * radius * np.cos(angle), radius + 0.9 * radius * np.sin(angle)], axis=1)
    outer, inner = side * y_out, side * (y_out - width)
    vertices = np.concatenate(
        [
            np.insert(ring, 1, inner, axis=1),
            np.insert(ring, 1, outer - side * 0.02, axis=1),
            np.insert(dish, 1, outer, axis=1),
            [[x, outer - side * 0.03, radius]],
        ]
    )
    i = np.arange(steps)
    j = (i + 1) % steps
    bands = [np.stack([i + k, j + k, j + k + steps, i + k, j + k + steps, i + k + steps], 1) for k in (0, steps)]
    hub = np.stack([i + 2 * steps, j + 2 * steps, np.full(steps, 3 * steps)], axis=1)
    triangles = np.concatenate([bands[0].reshape(-1, 3), bands[1].reshape(-1, 3), hub])
    if side < 0:
        triangles = triangles[:, ::-1]
    charts = np.full(len(triangles), Chart.WHEEL, dtype=np.uint8)
    charts[: 2 * steps] = Chart.DARK
    # A circle in x and z runs clockwise when it is seen from the left.
    return _with_normals(vertices, triangles[:, ::-1], charts, 50.0)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return all meshes as one; `extra` is not kept."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + np.int32(o) for m, o in zip(meshes, offsets, strict=True)]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.charts for m in meshes]),
    )
