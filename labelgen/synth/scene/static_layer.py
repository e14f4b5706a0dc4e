"""Props drawn into the picture of the road: their pixels, their shadows, and what they hide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import Camera
from labelgen.synth.scene.placement import Prop
from labelgen.synth.scene.scene import RoadScene, carriageways
from labelgen.synth.scene.strips import strips
from labelgen.synth.scene.triangles import Triangles, gather
from labelgen.synth.shading.lighting import Light
from labelgen.synth.shading.rasterizer import visible_triangles

__all__ = ["NO_SHADE", "Shade", "StaticLayer", "draw_props", "draw_shade", "without_view_blockers"]

_SS = 2
"""Samples per pixel and side."""
_STRIP = 120
"""Rows drawn at once: more need more memory."""
_CELL = 0.1
"""Side of a cell of the shade map, metres."""
_MAX_HIDDEN_SHARE = 0.012
"""Greatest share of the measured road that one prop may hide: more of it would hide too many vehicles."""


@dataclass(frozen=True, eq=False)
class Shade:
    """Map of the sunlight and skylight that reach the ground.

    Args:
        sun: (h, w) uint8, 255 in full sun.
        sky: (h, w) uint8, 255 in the open.
        grid: (3,) x and y of the map's corner in metres, and cells per metre.
    """

    sun: NDArray[np.uint8]
    sky: NDArray[np.uint8]
    grid: NDArray[np.float64]

    def at(self, plane: NDArray[np.uint8], x: Any, y: Any) -> Any:
        """Return values of `sun` or `sky` in [0, 1] at places x, y, metres on the road; 1 outside the map."""
        column = ((x - np.float32(self.grid[0])) * np.float32(self.grid[2])).astype(np.int32)
        row = ((y - np.float32(self.grid[1])) * np.float32(self.grid[2])).astype(np.int32)
        inside = (column >= 0) & (row >= 0) & (column < plane.shape[1]) & (row < plane.shape[0])
        value = plane[np.where(inside, row, 0), np.where(inside, column, 0)].astype(np.float32) / 255
        return np.where(inside, value, np.float32(1))


NO_SHADE = Shade(np.full((1, 1), 255, np.uint8), np.full((1, 1), 255, np.uint8), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, eq=False)
class StaticLayer:
    """The props of a picture, pixel by pixel.

    Args:
        cover: (H, W) uint8, share of each pixel that shows a prop, 255 for all of it.
        place: (H, W, 2) float32 metres, where on the ground that prop stands; 0 where there is none.
        shade: the light that the props leave to the ground.
    """

    cover: NDArray[np.uint8]
    place: NDArray[np.float32]
    shade: Shade

    def in_front(
        self, window_xyxy: tuple[int, int, int, int], bounds: tuple[float, float, float, float]
    ) -> NDArray[np.uint8] | None:
        """Return which share of each pixel of a window shows a prop nearer than a vehicle.

        Args:
            window_xyxy: px.
            bounds: ground of the vehicle, x0, x1, y0, y1 metres on the road; the camera stands above the origin.

        Returns:
            (h, w) uint8, 255 for a whole pixel; None where no prop is nearer.
        """
        x0, y0, x1, y1 = window_xyxy
        cover = self.cover[y0:y1, x0:x1]
        if not cover.any():
            return None
        x, y = self.place[y0:y1, x0:x1, 0], self.place[y0:y1, x0:x1, 1]
        low_x, high_x, low_y, high_y = bounds
        # A plane along or across the road parts prop and vehicle; the one on the camera's side of it is in front.
        beside_left, beside_right = y < low_y, y > high_y
        front = (beside_left & (low_y > 0)) | (beside_right & (high_y < 0))
        front |= ~(beside_left | beside_right) & (x < low_x) & (low_x > 0)
        # Above the vehicle, as a gantry is: nearer to the camera, which looks down.
        front |= ~(beside_left | beside_right) & (x >= low_x) & (x <= high_x)
        return np.where(front, cover, np.uint8(0)) if front.any() else None


def _on_screen(camera: Camera, triangles: Triangles) -> NDArray[np.float64]:
    """Return the corners (3 T, 3): frame px x, y and depth; depth -1 where they cannot be drawn."""
    points = triangles.corners.reshape(-1, 3).astype(np.float64)
    depth = (points - np.array([0.0, 0.0, camera.height_m])) @ camera.axes[:, 2]
    pixels = np.nan_to_num(camera.project(points), nan=-1e6)
    return np.concatenate([pixels, np.where(depth > 0.5, depth, -1.0)[:, None]], axis=1)


def _corner_numbers(triangles: Triangles) -> NDArray[np.int32]:
    return np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)


def without_view_blockers(scene: RoadScene, props: Sequence[Prop]) -> list[Prop]:
    """Return the props that hide little of the measured road."""
    if not props:
        return []
    camera = scene.camera
    height, width = scene.road_mask.shape
    quarter = (width // 4, height // 4)
    triangles = gather([p.triangles for p in props])
    owner = np.repeat(np.arange(len(props)), [len(p.triangles) for p in props])
    screen = _on_screen(camera, triangles)
    screen[:, :2] /= 4
    ids = visible_triangles(screen, _corner_numbers(triangles), quarter, (0.0, 0.0), 1, False)
    road = cv2.resize(scene.road_mask.astype(np.uint8), quarter, interpolation=cv2.INTER_NEAREST) > 0
    hidden = np.bincount(owner[ids[road & (ids >= 0)]], minlength=len(props))
    limit = _MAX_HIDDEN_SHARE * max(int(np.count_nonzero(road)), 1)
    return [p for k, p in enumerate(props) if hidden[k] <= limit]


def draw_shade(scene: RoadScene, light: Light, props: Sequence[Prop]) -> Shade:
    """Return the map of sunlight and skylight that the props leave to the road and its verges."""
    if not props:
        return NO_SHADE
    ways = carriageways(scene)
    corner = np.array([-5.0, min(w[0] for w in ways) - 14.0])
    far = np.array([145.0, max(w[1] for w in ways) + 14.0])
    size = [int(v) for v in ((far - corner) / _CELL).tolist()]
    triangles = gather([p.triangles for p in props])
    numbers, points = _corner_numbers(triangles), triangles.corners.reshape(-1, 3).astype(np.float64)

    def left(direction: NDArray[Any], sigma: float) -> NDArray[np.uint8]:
        foot = points[:, :2] - points[:, 2:] * (direction[:2] / direction[2])
        screen = np.concatenate([(foot - corner) / _CELL, np.ones((len(foot), 1))], axis=1)
        hit = visible_triangles(screen, numbers, (size[0], size[1]), (0.0, 0.0), 1, False) >= 0
        return np.asarray(cv2.GaussianBlur(np.where(hit, np.uint8(0), np.uint8(255)), (0, 0), sigma))

    sun = light.sun_direction
    open_sun = np.full(size[::-1], 255, np.uint8)
    lit = left(np.array([sun[0], sun[1], max(sun[2], 0.15)]), 0.6) if light.sun.max() > 0.05 else open_sun
    sky = left(np.array([0.0, 0.0, 1.0]), 6.0)
    return Shade(lit, (160 + 95 * (sky / 255.0)).astype(np.uint8), np.append(corner, 1 / _CELL))


def _radiance(camera: Camera, light: Light, triangles: Triangles) -> NDArray[np.float32]:
    """Return each triangle's linear RGB radiance (T, 3) towards the camera."""
    middle = triangles.corners.mean(axis=1)
    to_camera = np.array([0.0, 0.0, camera.height_m], dtype=np.float32) - middle
    facing = (to_camera * triangles.normals).sum(axis=1)
    normals = np.where((triangles.leafy | (facing >= 0))[:, None], triangles.normals, -triangles.normals)
    cosine = normals @ light.sun_direction.astype(np.float32)
    # Leaves let a part of the light through.
    direct = np.where(triangles.leafy, 0.35 + 0.65 * cosine, cosine).clip(0, 1)[:, None]
    up = (0.5 + 0.5 * normals[:, 2:]) * np.clip(0.6 + 0.2 * middle[:, 2:], 0, 1)
    bounce = (0.5 - 0.5 * normals[:, 2:]) * light.road_radiance
    lit = triangles.albedo * (direct * light.sun + up * light.ambient + 0.6 * bounce)
    return np.asarray(light.through_air(lit, np.linalg.norm(to_camera, axis=1)[:, None]), dtype=np.float32)


def _standing_at(
    camera: Camera, triangles: Triangles, ids: NDArray[np.int32], origin_px: tuple[int, int]
) -> NDArray[np.float32]:
    """Return (h, w, 2) metres: where on the ground what a part of the picture shows stands; 0 where it shows nothing.

    `ids` holds a triangle per pixel of the part, -1 for none; `origin_px` is the part's first pixel (x, y).
    """
    out = np.zeros((*ids.shape, 2), dtype=np.float32)
    row, column = np.nonzero(ids >= 0)
    if not len(row):
        return out
    corners = triangles.corners[ids[row, column]].astype(np.float64)
    eye = np.array([0.0, 0.0, camera.height_m])
    left, top = origin_px
    at = np.stack(
        [column + left + 0.5 - camera.pp[0], row + top + 0.5 - camera.pp[1], np.full(len(row), camera.focal)], axis=1
    )
    rays = at @ camera.axes.T
    plane = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (plane * (corners[:, 0] - eye)).sum(axis=1) / (plane * rays).sum(axis=1)
    spot = (eye + np.nan_to_num(far)[:, None] * rays)[:, :2]
    # Grazing rays meet the plane far off; the triangle itself bounds where that can be.
    out[row, column] = spot.clip(corners[..., :2].min(axis=1), corners[..., :2].max(axis=1))
    return out


def draw_props(
    image: Any, camera: Camera, light: Light, props: Sequence[Prop], shade: Shade,
    windows_xyxy: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.float32], StaticLayer | None]:  # fmt: skip
    """Lay the props over a picture.

    Args:
        image: (H, W, 3) float32 BGR in 0-255.
        camera: with the image's size.
        light: what they are lit by.
        props: the props.
        shade: goes into what is returned.
        windows_xyxy: (N, 4) px, the parts of the picture to draw; None for all of it.

    Returns:
        The picture, and what it hides; None when there are no props.
    """
    if not props:
        return image, None
    height, width = image.shape[:2]
    triangles = gather([p.triangles for p in props])
    ids = visible_triangles(
        _on_screen(camera, triangles), _corner_numbers(triangles), (width, height), (0.0, 0.0), _SS, False
    )
    tone = light.grey_levels(_radiance(camera, light, triangles))[:, ::-1]
    out, cover = image.copy(), np.zeros((height, width), dtype=np.uint8)
    place = np.zeros((height, width, 2), dtype=np.float32)
    for rows, columns in strips((width, height), _STRIP, windows_xyxy):
        part = ids[_SS * rows.start : _SS * rows.stop, _SS * columns.start : _SS * columns.stop]
        covered = part >= 0
        if not covered.any():
            continue
        size = (columns.stop - columns.start, rows.stop - rows.start)
        hit = covered.astype(np.float32)
        painted = cv2.resize(tone[np.maximum(part, 0)] * hit[..., None], size, interpolation=cv2.INTER_AREA)
        share: Any = cv2.resize(hit, size, interpolation=cv2.INTER_AREA)
        out[rows, columns] = out[rows, columns] * (1 - share[..., None]) + painted
        cover[rows, columns] = (255 * share).astype(np.uint8)
        nearest = part.reshape(size[1], _SS, size[0], _SS).max(axis=(1, 3))
        place[rows, columns] = _standing_at(camera, triangles, nearest, (columns.start, rows.start))
    return out, StaticLayer(cover, place, shade)
