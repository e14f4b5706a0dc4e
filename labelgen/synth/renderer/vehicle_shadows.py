"""Shadows on the road, drawn once per vehicle as a map around it.

A vehicle keeps its heading and the sun its place, so the light on the road around the vehicle does not change while it
drives. The map is drawn in metres and warped into each frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.lighting import Light
from labelgen.synth.vehicle.vehicle import VehicleModel

__all__ = ["GroundShadow", "ground_shadow", "shadow_colours"]

_CELL = 0.04
"""Side of a map cell, metres."""
_SKY_DIRECTIONS = 24
"""Directions from which skylight comes: more give smoother shadows and take longer."""
_PENUMBRA_M = 0.025
"""Sigma of the blur of the sun's shadow, metres: the sun is half a degree wide, the vehicle a metre or two high."""


@dataclass(frozen=True, eq=False)
class GroundShadow:
    """Shadow on the road around a vehicle.

    Args:
        left: (h, w) uint8, share that is left of the open road's grey levels; 255 at the border, all of them.
        to_body: (3, 3) map px -> metres x, y in the road frame relative to the vehicle's origin.
    """

    left: NDArray[np.uint8]
    to_body: NDArray[np.float64]


def _hulls(vehicle: VehicleModel) -> list[NDArray[np.float64]]:
    """Return convex pieces of the vehicle as points: mirrors, and slices along its length that keep a bonnet low."""
    points = _with_points_on_long_edges(vehicle)
    length = vehicle.size_lwh[0]
    edges = np.linspace(-length / 2, length / 2, 7)
    pieces = []
    for low, high in pairwise(edges.tolist()):
        piece = points[(points[:, 0] >= low - 0.2) & (points[:, 0] <= high + 0.2)]
        if len(piece) > 3:
            pieces.append(piece)
    mesh = vehicle.mesh
    beside = mesh.vertices[np.unique(mesh.triangles[len(mesh.body) :])]
    # Mirrors alone: an aerial's shadow is too thin to see.
    mirrors = [beside[beside[:, 1] * side > 0.25 * vehicle.size_lwh[1]] for side in (1, -1)]
    return (pieces or [points]) + [mirror for mirror in mirrors if len(mirror) > 3]


def _with_points_on_long_edges(vehicle: VehicleModel) -> NDArray[np.float64]:
    """Return the mesh's vertices, and points every few decimetres on long edges such as those of a box body."""
    vertices, triangles = vehicle.mesh.vertices, vehicle.mesh.body
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    long = np.abs(b - a)[:, 0] > 0.6
    share = np.linspace(0, 1, 40)[:, None, None]
    return np.concatenate(
        [vertices[vehicle.mesh.body_vertices], (a[long] + share * (b[long] - a[long])).reshape(-1, 3)]
    )


def ground_shadow(vehicle: VehicleModel, heading: int, light: Light) -> GroundShadow:
    """Draw the shadow map of a vehicle that drives towards +X (heading 1) or -X (heading -1)."""
    pieces = [p * np.array([heading, heading, 1.0]) for p in _hulls(vehicle)]
    sun, top = light.sun_direction, vehicle.size_lwh[2]
    strength = light.sun * max(sun[2], 0.0)
    sun_share = float(strength.sum() / (strength.sum() + light.ambient.sum()))
    reach = top * np.hypot(sun[0], sun[1]) / max(sun[2], 0.15) if sun_share > 0.02 else 0.0
    half = vehicle.size_lwh[:2] / 2 + 1.2 + reach
    w, h = (int(np.ceil(2 * v / _CELL)) for v in half)
    left: Any = np.zeros((h, w), dtype=np.float32)

    def cast(direction: NDArray[Any]) -> NDArray[np.uint8]:
        mask = np.zeros((h, w), dtype=np.uint8)
        for piece in pieces:
            foot = piece[:, :2] - piece[:, 2:] * (direction[:2] / direction[2])
            pixels = np.round((foot + half) / _CELL * 16).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(pixels), 255, cv2.LINE_AA, 4)
        return mask

    # The sky as a ring of directions at two heights, weighted by the cosine to the vertical.
    total = 0.0
    for tilt in (20.0, 48.0, 70.0):
        for k in range(_SKY_DIRECTIONS // 3):
            angle = 2 * np.pi * (k + tilt / 90) / (_SKY_DIRECTIONS // 3)
            s, c = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
            weight = s * c
            left += weight * (255 - cast(np.array([s * np.cos(angle), s * np.sin(angle), c]))).astype(np.float32)
            total += weight
    left *= (1 - sun_share) / (255 * total)
    left = cv2.GaussianBlur(left, (0, 0), 0.07 / _CELL)
    if sun_share > 0.02:
        direction = np.array([sun[0], sun[1], max(sun[2], 0.15)])
        lit = cv2.GaussianBlur(255 - cast(direction), (0, 0), _PENUMBRA_M / _CELL)
        left += sun_share * lit.astype(np.float32) / 255
    else:
        left += sun_share
    # Fade to open road at the border of the map.
    margin = np.minimum(
        np.minimum(np.arange(w), np.arange(w)[::-1])[None], np.minimum(np.arange(h), np.arange(h)[::-1])[:, None]
    )
    fade = np.clip(margin / (0.5 / _CELL), 0, 1).astype(np.float32)
    left = 1 - fade * (1 - left)
    # What the camera's curve makes of darker asphalt, as a share of what it makes of the open road's.
    shares = np.linspace(0, 1, 256)
    grey = light.grey_levels(shares[:, None] * light.road_radiance).mean(axis=1)
    levels = np.interp(left.clip(0, 1), shares, (255 * grey / max(float(grey[-1]), 1.0)).clip(0, 255))
    levels = levels.round().astype(np.uint8)
    x, y, w, h = cv2.boundingRect((levels < 252).astype(np.uint8))
    to_body = np.array(
        [[_CELL, 0, x * _CELL - half[0] + _CELL / 2], [0, _CELL, y * _CELL - half[1] + _CELL / 2], [0, 0, 1]]
    )
    return GroundShadow(levels[y : y + h, x : x + w].copy(), to_body)


def shadow_colours(light: Light) -> NDArray[np.float32]:
    """Return (256, 3) BGR: the share a shadow leaves of each colour, by the share it leaves of the grey levels.

    The sky alone lights a shadow, which tints it.
    """
    sun = light.sun * max(light.sun_direction[2], 0.0)
    sky_share = float(light.ambient.sum() / (sun.sum() + light.ambient.sum()))
    shares = np.linspace(0, 1, 256)
    sunlit = np.clip((shares - sky_share) / max(1 - sky_share, 1e-6), 0, 1)[:, None]
    dim = np.minimum(shares / sky_share, 1)[:, None]
    colours = light.grey_levels(light.road * (light.ambient * dim + sun * sunlit))[:, ::-1]
    left = colours / np.maximum(colours[-1], 1.0)
    grey = np.maximum(left.mean(axis=1), 1 / 255)
    # By grey levels rather than by light, and none of them brighter or darker on the whole.
    steps = np.arange(256) / 255
    at = np.interp(steps, grey, shares) * 255
    tint = np.stack([np.interp(at, np.arange(256), left[:, k] / grey) for k in range(3)], axis=1)
    return np.asarray((steps[:, None] * tint).clip(0, 1), dtype=np.float32)
