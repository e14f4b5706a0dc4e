"""Vehicles as cuboids on the road, in the road frame of `camera`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array

__all__ = ["cuboid_sizes", "road_cuboids"]


def road_cuboids(near_xy: ArrayLike, sizes_lwh: ArrayLike) -> Array:
    """Cuboids aligned with the direction of travel.

    Args:
        near_xy: (N, 2) metres, middle of the bottom edge nearest to the camera.
        sizes_lwh: (N, 3) metres, length (along X), width (along Y), height.

    Returns:
        (N, 8, 3) metres, vertices in the order of `box3d`, the side facing the camera as the visible one.
    """
    x, y = np.asarray(near_xy, dtype=np.float64).T
    length, width, height = np.asarray(sizes_lwh, dtype=np.float64).T
    # The camera stands at Y = 0: of a vehicle to the left of it (Y > 0) the right side (less Y) is seen.
    seen = y - np.where(y >= 0, 1.0, -1.0) * width / 2
    hidden = 2 * y - seen
    ground = np.stack(
        [
            np.stack([x, hidden], axis=1),
            np.stack([x, seen], axis=1),
            np.stack([x + length, seen], axis=1),
            np.stack([x + length, hidden], axis=1),
        ],
        axis=1,
    )
    zeros = np.zeros((len(x), 4, 1))
    top = np.concatenate([ground, zeros + height[:, None, None]], axis=2)
    return np.concatenate([top, np.concatenate([ground, zeros], axis=2)], axis=1)


def cuboid_sizes(vertices_px: ArrayLike, camera: Camera) -> Array:
    """Length, width and height in metres of boxes standing on the road.

    Args:
        vertices_px: (N, 8, 2) frame px, vertices in the order of `box3d`.
        camera: with a scale.

    Returns:
        (N, 3) metres; NaN where a bottom vertex is not on the road.
    """
    points = np.asarray(vertices_px, dtype=np.float64).reshape(-1, 8, 2)
    ground = camera.road_points(points[:, 4:], invalid="nan")
    width = np.linalg.norm(ground[:, 1] - ground[:, 0], axis=-1)
    length = np.linalg.norm(ground[:, 2] - ground[:, 1], axis=-1)
    # Height: where the rays of the top front corners pass above the bottom front corners. The vertical through a
    # corner and the ray share a plane, so how far the ray has fallen at the corner's distance decides.
    rays = camera.rays(points[:, :2])
    with np.errstate(divide="ignore", invalid="ignore"):
        fall = rays[..., 2] / np.linalg.norm(rays[..., :2], axis=-1)
    height = camera.height_m + (np.linalg.norm(ground[:, :2], axis=-1) * fall).mean(axis=1)
    return np.stack([length, width, height], axis=1)
