"""A picture of an empty road, drawn from nothing: asphalt, markings, verge, guard rails, trees and sky."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import Camera
from labelgen.synth.light import Light, Weather
from labelgen.synth.mesh import box_mesh, join
from labelgen.synth.raster import visible_triangles
from labelgen.synth.scenes import LANE_WIDTH, Scene

__all__ = ["draw_road"]

_TILE = 512
Array = NDArray[np.float64]


def _noise_tile(rng: np.random.Generator, cells: tuple[float, ...]) -> NDArray[np.float32]:
    """(512, 512) noise that repeats, zero mean and unit spread, the sum of blurred white noise."""
    total = np.zeros((_TILE, _TILE), dtype=np.float32)
    for sigma in cells:
        white = rng.normal(size=(_TILE, _TILE)).astype(np.float32)
        if sigma > 0:
            pad = int(4 * sigma) + 1
            white = cv2.GaussianBlur(np.pad(white, pad, mode="wrap"), (0, 0), sigma)[pad:-pad, pad:-pad]
        total += white / white.std()
    return total / total.std()


def _lookup(tile: NDArray[np.float32], x: Any, y: Any, metres: float) -> NDArray[np.float32]:
    u = np.mod(x * (_TILE / metres), _TILE).astype(np.int32)
    v = np.mod(y * (_TILE / metres), _TILE).astype(np.int32)
    out: NDArray[np.float32] = tile[v % _TILE, u % _TILE]
    return out


def draw_road(scene: Scene, light: Light, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The empty road of a procedural scene.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    camera = scene.camera
    assert camera.image_wh is not None
    width, height = camera.image_wh
    columns, rows = np.meshgrid(np.arange(2 * width) / 2 + 0.25, np.arange(2 * height) / 2 + 0.25)
    pixels = np.stack([columns, rows], axis=-1)
    ground = camera.road_points(pixels, invalid="nan").astype(np.float32)
    x, y = ground[..., 0], ground[..., 1]
    sky = ~np.isfinite(x) | (np.hypot(x, y) > 900)
    x, y = np.where(sky, 0, x), np.where(sky, 0, y)
    # One sample covers this many metres: detail finer than that must fade out.
    footprint = np.maximum((x * x + y * y + camera.height_m**2) / (camera.height_m * camera.focal * 2), 1e-3)
    colour = _ground_colour(scene, light, rng, x, y, footprint)
    sun = light.sun * max(light.sun_direction[2], 0.0) + light.ambient
    radiance = colour * sun.astype(np.float32)
    if light.weather is Weather.RAIN:
        radiance = _wet(scene, light, rng, radiance, x, y)
    radiance = _backdrop(scene, light, rng, radiance, sky, columns, rows, x, y)
    value = np.clip(radiance * light.exposure, 0, 4)
    value = np.where(value > 0.6, 0.6 + 0.4 * (1 - np.exp(-(value - 0.6) / 0.4)), value) ** (1 / 2.2)
    image = cv2.resize((255 * value[..., ::-1]).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    image = _guard_rails(scene, light, image)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.55), 0, 255).astype(np.uint8)


def _soft(value: Any, width: Any) -> Any:
    """0 to 1 around zero, over `width`."""
    return np.clip(value / np.maximum(width, 1e-4) + 0.5, 0, 1)


def _edges(scene: Scene) -> list[tuple[float, float, list[float]]]:
    """Per carriageway its two borders and the borders between its lanes, metres."""
    groups = []
    for measured in (True, False):
        middles = sorted(lane.y0 for lane in scene.lanes if (lane.index is not None) == measured)
        if middles:
            inner = [(a + b) / 2 for a, b in zip(middles[:-1], middles[1:], strict=True)]
            groups.append((middles[0] - LANE_WIDTH / 2, middles[-1] + LANE_WIDTH / 2, inner))
    return groups


def _ground_colour(
    scene: Scene, light: Light, rng: np.random.Generator, x: Any, y: Any, footprint: Any
) -> NDArray[np.float32]:
    fine, coarse = _noise_tile(rng, (0.0, 1.0)), _noise_tile(rng, (4.0, 16.0, 40.0))
    grass_tile = _noise_tile(rng, (0.7, 2.0, 8.0))
    grain = _lookup(fine, x, y, 6.0) * np.clip(0.012 / footprint, 0, 1)
    patches = _lookup(coarse, x, y * 2.5, 40.0) + 0.6 * _lookup(coarse, x * 0.13, y, 17.0)
    road = light.road.astype(np.float32)
    green = np.array([0.055, 0.085, 0.022], dtype=np.float32) * rng.uniform(0.7, 1.2)
    dry = np.array([0.16, 0.135, 0.075], dtype=np.float32)
    mix = np.clip(0.35 + 0.25 * _lookup(coarse, x, y, 23.0), 0, 1)[..., None]
    blades = np.exp(0.35 * _lookup(grass_tile, x, y, 9.0) * np.clip(0.05 / footprint, 0.15, 1))
    colour = (green * (1 - mix) + dry * mix) * blades[..., None]
    asphalt = road * (1 + 0.10 * grain + 0.05 * patches)[..., None]
    gravel = np.array([0.21, 0.20, 0.18], dtype=np.float32) * (1 + 0.18 * grain + 0.06 * patches)[..., None]
    shoulder = rng.uniform(0.6, 2.6)
    for low, high, inner in _edges(scene):
        for extra, layer in ((shoulder + 0.9, gravel), (shoulder, asphalt * 1.08)):
            inside = _soft(y - (low - extra), footprint + 0.06) * _soft(high + extra - y, footprint + 0.06)
            colour = colour * (1 - inside[..., None]) + layer * inside[..., None]
        inside = _soft(y - low + 0.3, footprint) * _soft(high + 0.3 - y, footprint)
        lanes = [low, *inner, high]
        tracks = sum(
            np.exp(-(((y - (a + b) / 2 - side * 0.85) / 0.28) ** 2))
            for a, b in zip(lanes[:-1], lanes[1:], strict=True)
            for side in (-1, 1)
        )
        oil = sum(np.exp(-(((y - (a + b) / 2) / 0.35) ** 2)) for a, b in zip(lanes[:-1], lanes[1:], strict=True))
        worn = asphalt * (1 + 0.07 * tracks - 0.08 * oil)[..., None]
        colour = colour * (1 - inside[..., None]) + worn * inside[..., None]
        colour = _markings(colour, x, y, footprint, low, high, inner, rng, patches + grain)
    return colour.astype(np.float32)


def _markings(
    colour: Any, x: Any, y: Any, footprint: Any, low: float, high: float, inner: list[float],
    rng: np.random.Generator, wear: Any,
) -> Any:  # fmt: skip
    white = np.array([0.62, 0.62, 0.59], dtype=np.float32) * rng.uniform(0.7, 1.0)
    dash, period = (3.0, 9.0) if rng.random() < 0.5 else (6.0, 18.0)
    phase = rng.uniform(0, period)

    def stripe(at: float, width: float) -> Any:
        return _soft(y - (at - width / 2), footprint) * _soft(at + width / 2 - y, footprint)

    cover = np.maximum(stripe(low, 0.20), stripe(high, 0.20))
    along = np.mod(x + phase, period)
    long = footprint * 6
    dashes = _soft(along, long) * _soft(dash - along, long)
    for at in inner:
        cover = np.maximum(cover, stripe(at, 0.13) * dashes)
    cover = np.clip(cover * np.clip(0.9 - 0.12 * wear, 0.3, 1), 0, 1)[..., None]
    return colour * (1 - cover) + white * cover


def _wet(scene: Scene, light: Light, rng: np.random.Generator, radiance: Any, x: Any, y: Any) -> Any:
    """Sky mirrored in a film of water, more the flatter one looks."""
    distance = np.sqrt(x * x + y * y)
    cosine = scene.camera.height_m / np.sqrt(distance**2 + scene.camera.height_m**2)
    fresnel = 0.02 + 0.6 * (1 - cosine) ** 5
    film = 0.75 + 0.25 * np.clip(_lookup(_noise_tile(rng, (6.0, 20.0)), x * 0.3, y, 14.0), -1, 1)
    share = np.clip(fresnel * film, 0, 1)[..., None]
    return radiance * (1 - share) + light.sky_low.astype(np.float32) * share


def _backdrop(
    scene: Scene, light: Light, rng: np.random.Generator, radiance: Any, sky: Any, columns: Any, rows: Any,
    x: Any, y: Any,
) -> Any:  # fmt: skip
    """Trees beside the road and sky above the horizon."""
    camera = scene.camera
    low, high = light.sky_low.astype(np.float32), light.sky_high.astype(np.float32)
    horizon_row = rows[sky].max() if sky.any() else -1.0
    climb = np.clip((horizon_row - rows) / (0.8 * camera.focal), 0, 1)[..., None]
    radiance = np.where(sky[..., None], low + (high - low) * np.sqrt(climb), radiance)
    # Each side's trees stand on a line along the road; their crowns reach up in the image by their height.
    crowns = _noise_tile(rng, (2.0, 6.0, 20.0))
    leaves = _noise_tile(rng, (0.5, 1.5, 5.0))
    borders = _edges(scene)
    outer = (min(b[0] for b in borders) - rng.uniform(7, 16), max(b[1] for b in borders) + rng.uniform(7, 16))
    origin = np.array([0.0, 0.0, camera.height_m])
    rays = (
        np.stack([columns - camera.pp[0], rows - camera.pp[1], np.full_like(columns, camera.focal)], -1) @ camera.axes.T
    )
    for side in outer:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (side - origin[1]) / rays[..., 1]
        hit_x, hit_z = t * rays[..., 0], origin[2] + t * rays[..., 2]
        tall = 7.0 + 2.2 * _lookup(crowns, np.nan_to_num(hit_x), np.full_like(hit_x, side), 160.0)
        seen = (t > 0) & np.isfinite(t) & (hit_z > 0) & (hit_z < tall) & (hit_x < 700)
        texture = _lookup(leaves, np.nan_to_num(hit_x), np.nan_to_num(hit_z), 11.0)
        depth = np.clip(1 - (tall - hit_z) / 9, 0.25, 1)
        tree = light.horizon * 1.2 * (1 + 0.0 * side)
        shaded = (tree * (depth * np.exp(0.45 * texture))[..., None]).astype(np.float32)
        radiance = np.where(seen[..., None], shaded, radiance)
    return radiance


def _guard_rails(scene: Scene, light: Light, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rails on posts along the outer borders of the measured carriageway."""
    camera = scene.camera
    low, high, _ = _edges(scene)[0]
    rails = []
    for y in (
        (low - 2.9, high + 2.9)
        if len(_edges(scene)) == 1
        else (low - 2.9 if scene.lanes[0].heading > 0 else high + 2.9,)
    ):
        for x in np.arange(2.0, 160.0, 4.0):
            rails.append(box_mesh((x, y - 0.03, 0.45), (x + 4.0, y + 0.03, 0.75)))
            rails.append(box_mesh((x, y - 0.05, 0.0), (x + 0.1, y + 0.05, 0.55)))
    mesh = join(rails)
    depth = (mesh.vertices - np.array([0.0, 0.0, camera.height_m])) @ camera.axes[:, 2]
    pixels = np.nan_to_num(camera.project(mesh.vertices), nan=-1e6)
    screen = np.concatenate([pixels, np.where(depth > 1, depth, -1.0)[:, None]], axis=1)
    ss = 2
    size = camera.image_wh
    assert size is not None
    ids = visible_triangles(screen, mesh.triangles, size, (0.0, 0.0), ss, True)
    normals = mesh.normals.mean(axis=1)
    lit = (
        np.clip(normals @ light.sun_direction, 0, 1)[:, None] * light.sun + (0.5 + 0.5 * normals[:, 2:]) * light.ambient
    )
    steel = np.array([0.36, 0.37, 0.38]) * lit * light.exposure
    tone = (255 * np.clip(steel, 0, 1) ** (1 / 2.2))[:, ::-1].astype(np.float32)
    cover = (ids >= 0).astype(np.float32)[..., None]
    painted = tone[np.maximum(ids, 0)] * cover
    rows, columns = size[1], size[0]
    painted = painted.reshape(rows, ss, columns, ss, 3).mean(axis=(1, 3))
    cover = cover.reshape(rows, ss, columns, ss, 1).mean(axis=(1, 3))
    return (image * (1 - cover) + painted).astype(np.float32)
