"""Cuboids that stand on the road: their vertices from position and size, and their size from vertices.

Convention:
    Road frame of `labelgen.geometry.camera`: float64 metres, X along VP1, Y to the left, Z up. Sizes are (N, 3) as
    length (along X), width (along Y), height. Vertices stand in the order of `labelgen.geometry.box_codec`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array

__all__ = ["cuboid_sizes", "road_cuboids"]


def road_cuboids(near_xy: ArrayLike, sizes_lwh: ArrayLike) -> Array:
    """Return the vertices of cuboids aligned with the direction of travel.

    Args:
        near_xy: (N, 2) metres, middle of the bottom edge nearest to the camera.
        sizes_lwh: (N, 3) metres.

    Returns:
        (N, 8, 3) metres; the visible side is the one that faces the camera.
    """
    x, y = np.asarray(near_xy, dtype=np.float64).T
    length, width, height = np.asarray(sizes_lwh, dtype=np.float64).T
    # The camera stands at Y = 0: of a vehicle to its left (Y > 0) the right side (smaller Y) is visible.
    visible = y - np.where(y >= 0, 1.0, -1.0) * width / 2
    hidden = 2 * y - visible
    ground = np.stack(
        [
            np.stack([x, hidden], axis=1),
            np.stack([x, visible], axis=1),
            np.stack([x + length, visible], axis=1),
            np.stack([x + length, hidden], axis=1),
        ],
        axis=1,
    )
    zeros = np.zeros((len(x), 4, 1))
    top = np.concatenate([ground, zeros + height[:, None, None]], axis=2)
    return np.concatenate([top, np.concatenate([ground, zeros], axis=2)], axis=1)


def cuboid_sizes(vertices_px: ArrayLike, camera: Camera) -> Array:
    """Return length, width and height of 3D boxes that stand on the road.

    Args:
        vertices_px: (N, 8, 2) frame px.
        camera: with a scale.

    Returns:
        (N, 3) metres; NaN where a bottom vertex lies on or above the horizon.

    Raises:
        CalibrationError: the camera has no scale.
    """
    points = np.asarray(vertices_px, dtype=np.float64).reshape(-1, 8, 2)
    ground = camera.road_points(points[:, 4:], invalid="nan")
    width = np.linalg.norm(ground[:, 1] - ground[:, 0], axis=-1)
    length = np.linalg.norm(ground[:, 2] - ground[:, 1], axis=-1)
    # Height: the ray of a top front corner at the horizontal distance of the corner below it. Ray and vertical edge
    # share a plane, so the ray's descent over that distance gives the height.
    rays = camera.rays(points[:, :2])
    with np.errstate(divide="ignore", invalid="ignore"):
        fall = rays[..., 2] / np.linalg.norm(rays[..., :2], axis=-1)
    height = camera.height_m + (np.linalg.norm(ground[:, :2], axis=-1) * fall).mean(axis=1)
    return np.stack([length, width, height], axis=1)
