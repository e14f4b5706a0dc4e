"""Triangles of props, each with one colour: plates, boxes, rods and leaves.

Convention: metres in the road frame (x along the road, y left, z up).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Triangles", "blob_leaves", "box", "box_leaves", "gather", "plate", "rod"]

Tone = Sequence[float]


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles without order.

    Args:
        corners: (T, 3, 3) float32 metres.
        albedo: (T, 3) float32 linear RGB.
        normals: (T, 3) float32 unit normals; either sign for flat things, which are lit on the side that is seen.
        leafy: (T,) bool, triangles whose normal is that of the crown they belong to.
    """

    corners: NDArray[np.float32]
    albedo: NDArray[np.float32]
    normals: NDArray[np.float32]
    leafy: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.corners)

    def moved(self, offset: Sequence[float]) -> Triangles:
        """Return the triangles moved by (3,) metres."""
        return Triangles(self.corners + np.asarray(offset, dtype=np.float32), self.albedo, self.normals, self.leafy)


def _flat(corners: Any, tone: Tone | NDArray[Any]) -> Triangles:
    corners = np.asarray(corners, dtype=np.float32).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    albedo = np.broadcast_to(np.asarray(tone, dtype=np.float32), (len(corners), 3)).copy()
    return Triangles(corners, albedo, normals, np.zeros(len(corners), dtype=np.bool_))


def plate(a: Sequence[float], b: Sequence[float], c: Sequence[float], d: Sequence[float], tone: Tone) -> Triangles:
    """Return a flat quadrilateral, its corners in order around it."""
    return _flat([[a, b, c], [a, c, d]], tone)


_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3), (0, 2, 6, 4))


def box(low: Sequence[float], high: Sequence[float], tone: Tone, *, piece_m: float = 8.0) -> Triangles:
    """Return an axis-aligned box.

    It is cut along x into pieces of at most `piece_m` metres, so that each pixel knows where on the road it stands.
    """
    edges = np.linspace(low[0], high[0], max(1, int(np.ceil((high[0] - low[0]) / piece_m))) + 1)
    parts = []
    for x0, x1 in pairwise(edges.tolist()):
        corner = np.array([[x, y, z] for x in (x0, x1) for y in (low[1], high[1]) for z in (low[2], high[2])])
        parts += [corner[[[f[0], f[1], f[2]], [f[0], f[2], f[3]]]] for f in _FACES]
    return _flat(np.concatenate(parts), tone)


def rod(a: Sequence[float], b: Sequence[float], radius: float, tone: Tone, *, sides: int = 6) -> Triangles:
    """Return a round bar between two points; `radius` in metres."""
    start, end = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    across = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(along, across))
    p, q = start + ring, end + ring
    p2, q2 = np.roll(p, -1, axis=0), np.roll(q, -1, axis=0)
    return _flat(np.concatenate([np.stack([p, p2, q2], 1), np.stack([p, q2, q], 1)]), tone)


def _leaves(
    centres: NDArray[Any], normals: NDArray[Any], size: float, tones: NDArray[Any], rng: np.random.Generator
) -> Triangles:
    """Return one triangle per leaf, turned at random and lit like the surface of the crown at its place."""
    spread = rng.normal(0, size, (len(centres), 3, 3)).astype(np.float32)
    unit = normals + rng.normal(0, 0.35, normals.shape)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-9)
    corners = (centres[:, None] + spread).astype(np.float32)
    corners[..., 2] = np.maximum(corners[..., 2], 0.01)
    return Triangles(corners, tones.astype(np.float32), unit.astype(np.float32), np.ones(len(centres), dtype=np.bool_))


def blob_leaves(
    centre: Sequence[float], radii: Sequence[float], leaf_m: float, tone: Tone, rng: np.random.Generator
) -> Triangles:
    """Return the leaves of an uneven ellipsoid: clumps over its surface, darker inside and below."""
    radius = np.asarray(radii, dtype=np.float64)
    clumps = int(rng.integers(14, 26))
    seat = rng.normal(size=(clumps, 3))
    seat *= (rng.uniform(0.35, 0.85, clumps) / np.linalg.norm(seat, axis=1))[:, None]
    area = 4 * np.pi * float(np.mean(radius)) ** 2
    count = int(np.clip(1.3 * area / leaf_m**2, 150, 2600))
    pick = rng.integers(0, clumps, count)
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    spot = seat[pick] + out * rng.uniform(0.22, 0.42, count)[:, None]
    outward = out + 0.8 * spot
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    depth = np.clip(0.35 + 0.5 * np.linalg.norm(spot, axis=1) + 0.25 * spot[:, 2], 0.25, 1.15)
    tones = (
        np.asarray(tone)
        * (depth * np.exp(rng.normal(0, 0.22, count)) * np.exp(rng.normal(0, 0.15, clumps))[pick])[:, None]
    )
    return _leaves(np.asarray(centre) + spot * radius, outward / radius * radius.min(), leaf_m, tones, rng)


def box_leaves(
    low: Sequence[float], high: Sequence[float], leaf_m: float, tone: Tone, rng: np.random.Generator
) -> Triangles:
    """Return the leaves of a trimmed hedge: over the top and the sides of a box."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    size = b - a
    faces = [(2, 1.0, size[0] * size[1]), (1, 1.0, size[0] * size[2]), (1, -1.0, size[0] * size[2])]
    faces += [(0, 1.0, size[1] * size[2]), (0, -1.0, size[1] * size[2])]
    shares = np.array([f[2] for f in faces])
    count = int(np.clip(2.2 * shares.sum() / leaf_m**2, 80, 4000))
    which = rng.choice(len(faces), count, p=shares / shares.sum())
    spot = a + size * rng.random((count, 3))
    normals = np.zeros((count, 3))
    for k, (axis, sign, _) in enumerate(faces):
        here = which == k
        spot[here, axis] = (b if sign > 0 else a)[axis] - sign * rng.uniform(0, 0.12, here.sum())
        normals[here, axis] = sign
    depth = np.clip(0.45 + 0.6 * (spot[:, 2] - a[2]) / max(size[2], 0.1), 0.4, 1.05)
    tones = np.asarray(tone) * (depth * np.exp(rng.normal(0, 0.25, count)))[:, None]
    return _leaves(spot, normals, leaf_m, tones, rng)


def gather(parts: Sequence[Triangles]) -> Triangles:
    """Join triangles into one object."""
    return Triangles(
        np.concatenate([p.corners for p in parts]),
        np.concatenate([p.albedo for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.leafy for p in parts]),
    )
