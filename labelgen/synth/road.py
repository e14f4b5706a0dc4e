"""A picture of an empty road, drawn from nothing: asphalt, markings, verge, guard rails, trees and sky."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.light import Light, Weather
from labelgen.synth.mesh import box_mesh, join
from labelgen.synth.raster import CURVE, visible_triangles
from labelgen.synth.scenes import LANE_WIDTH, Scene

__all__ = ["draw_road", "to_grey_levels"]

_TILE = 512
_STRIP = 48
_SS = 2
Plane = NDArray[np.float32]


def _noise_tile(rng: np.random.Generator, cells: tuple[float, ...]) -> Plane:
    """(512, 512) noise that repeats, zero mean and unit spread: white noise blurred at several scales, summed."""
    total = np.zeros((_TILE, _TILE), dtype=np.float32)
    for sigma in cells:
        white: Any = rng.normal(size=(_TILE, _TILE)).astype(np.float32)
        if sigma > 0:
            pad = int(4 * sigma) + 1
            white = cv2.GaussianBlur(np.pad(white, pad, mode="wrap"), (0, 0), sigma)[pad:-pad, pad:-pad]
        total += white / white.std()
    out: Plane = total / total.std()
    return out


def _lookup(tile: Plane, x: Plane, y: Plane, metres: float) -> Plane:
    k = np.float32(_TILE / metres)
    out: Plane = tile[(y * k).astype(np.int32) & (_TILE - 1), (x * k).astype(np.int32) & (_TILE - 1)]
    return out


def to_grey_levels(radiance: Any) -> Plane:
    """Linear light to 0-255 by the same curve as vehicles."""
    at = (np.clip(radiance, 0, 4) * ((len(CURVE) - 2) / 4)).astype(np.int32)
    out: Plane = CURVE[at]
    return out


@dataclass(frozen=True, eq=False)
class _Look:
    """What is decided once per picture: noise, colours, wear and where things stand."""

    grain: Plane
    patches: Plane
    grass: Plane
    crowns: Plane
    leaves: Plane
    green: Plane
    white: Plane
    shoulder: float
    dash: tuple[float, float, float]
    trees_y: tuple[float, float]
    trees_m: float


def _look(scene: Scene, rng: np.random.Generator) -> _Look:
    borders = _carriageways(scene)
    dash, period = (3.0, 9.0) if rng.random() < 0.5 else (6.0, 18.0)
    return _Look(
        _noise_tile(rng, (0.0, 1.0)),
        _noise_tile(rng, (4.0, 16.0, 40.0)),
        _noise_tile(rng, (0.7, 2.0, 8.0)),
        _noise_tile(rng, (1.0, 3.0, 9.0)),
        _noise_tile(rng, (0.8, 2.5, 6.0)),
        np.array([0.055, 0.085, 0.022], dtype=np.float32) * np.float32(rng.uniform(0.7, 1.2)),
        np.array([0.62, 0.62, 0.59], dtype=np.float32) * np.float32(rng.uniform(0.7, 1.0)),
        rng.uniform(0.6, 2.6),
        (dash, period, rng.uniform(0, period)),
        (min(b[0] for b in borders) - rng.uniform(8, 18), max(b[1] for b in borders) + rng.uniform(8, 18)),
        rng.uniform(4.5, 9.0),
    )


def draw_road(scene: Scene, light: Light, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The empty road of a procedural scene.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    camera = scene.camera
    assert camera.image_wh is not None
    width, height = camera.image_wh
    look = _look(scene, rng)
    columns = ((np.arange(_SS * width) + 0.5) / _SS)[None]
    image = np.empty((height, width, 3), dtype=np.float32)
    for top in range(0, height, _STRIP):
        bottom = min(top + _STRIP, height)
        rows = (top + (np.arange(_SS * (bottom - top)) + 0.5) / _SS)[:, None]
        levels = to_grey_levels(_strip(scene, light, look, columns, rows) * light.exposure)
        image[top:bottom] = cv2.resize(levels[..., ::-1], (width, bottom - top), interpolation=cv2.INTER_AREA)
    image = _guard_rails(scene, light, image)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.55), 0, 255).astype(np.uint8)


def _strip(scene: Scene, light: Light, look: _Look, columns: NDArray[Any], rows: NDArray[Any]) -> Plane:
    """(h, w, 3) radiance of some rows of samples."""
    camera = scene.camera
    axes = camera.axes
    dx, dy = columns - camera.pp[0], rows - camera.pp[1]
    rays = [(axes[k, 0] * dx + axes[k, 1] * dy + axes[k, 2] * camera.focal).astype(np.float32) for k in range(3)]
    down = -rays[2]
    reach = np.float32(camera.height_m) / np.maximum(down, np.float32(1e-3))
    x, y = rays[0] * reach, rays[1] * reach
    sky = (down <= 1e-3) | (x * x + y * y > 900.0**2)
    x, y = np.where(sky, np.float32(0), x), np.where(sky, np.float32(0), y)
    # One sample covers this many metres: detail finer than that must fade out.
    footprint = (x * x + y * y + np.float32(camera.height_m**2)) * np.float32(
        1 / (_SS * camera.height_m * camera.focal)
    )
    sunlight = (light.sun * max(light.sun_direction[2], 0.0) + light.ambient).astype(np.float32)
    radiance = _ground(scene, light, look, x, y, footprint) * sunlight
    if light.weather is Weather.RAIN:
        radiance = _wet(scene, light, look, radiance, x, y)
    if sky.any():
        climb = np.clip(rays[2] / np.float32(0.8 * camera.focal), 0, 1)[..., None]
        low, high = light.sky_low.astype(np.float32), light.sky_high.astype(np.float32)
        radiance = np.where(sky[..., None], low + (high - low) * np.sqrt(climb), radiance)
    for side in look.trees_y:
        radiance = _trees(scene, light, look, radiance, rays, side)
    return np.asarray(radiance, dtype=np.float32)


def _soft(value: Any, width: Any) -> Any:
    """0 to 1 around zero, over `width`."""
    return np.clip(value / np.maximum(width, np.float32(1e-4)) + np.float32(0.5), 0, 1)


def _carriageways(scene: Scene) -> list[tuple[float, float, list[float]]]:
    """Per carriageway its two borders and the borders between its lanes, metres."""
    groups = []
    for measured in (True, False):
        middles = sorted(lane.y0 for lane in scene.lanes if (lane.index is not None) == measured)
        if middles:
            inner = [(a + b) / 2 for a, b in pairwise(middles)]
            groups.append((middles[0] - LANE_WIDTH / 2, middles[-1] + LANE_WIDTH / 2, inner))
    return groups


def _ground(scene: Scene, light: Light, look: _Look, x: Plane, y: Plane, footprint: Plane) -> Plane:
    """Albedo of grass, gravel, asphalt and markings."""
    grain = _lookup(look.grain, x, y, 6.0) * np.clip(0.012 / footprint, 0, 1)
    patches = _lookup(look.patches, x, y * 2.5, 40.0) + 0.6 * _lookup(look.patches, x * 0.13, y, 17.0)
    dry = np.array([0.16, 0.135, 0.075], dtype=np.float32)
    mix = np.clip(0.35 + 0.25 * _lookup(look.patches, x, y, 23.0), 0, 1)[..., None]
    blades = np.exp(0.35 * _lookup(look.grass, x, y, 9.0) * np.clip(0.05 / footprint, 0.15, 1))
    colour = (look.green * (1 - mix) + dry * mix) * blades[..., None]
    asphalt = light.road.astype(np.float32) * (1 + 0.10 * grain + 0.05 * patches)[..., None]
    gravel = np.array([0.21, 0.20, 0.18], dtype=np.float32) * (1 + 0.18 * grain + 0.06 * patches)[..., None]
    for low, high, inner in _carriageways(scene):
        for extra, layer in ((look.shoulder + 0.9, gravel), (look.shoulder, asphalt * 1.08)):
            inside = _soft(y - (low - extra), footprint + 0.06) * _soft(high + extra - y, footprint + 0.06)
            colour = colour * (1 - inside[..., None]) + layer * inside[..., None]
        inside = _soft(y - low + 0.3, footprint) * _soft(high + 0.3 - y, footprint)
        wear = np.ones_like(y)
        lanes = [low, *inner, high]
        for a, b in pairwise(lanes):
            middle = (a + b) / 2
            for side in (-0.85, 0.85):
                wear += 0.07 * np.exp(-(((y - middle - side) / 0.28) ** 2))
            wear -= 0.08 * np.exp(-(((y - middle) / 0.35) ** 2))
        colour = colour * (1 - inside[..., None]) + asphalt * (wear * inside)[..., None]
        colour = _markings(look, colour, x, y, footprint, (low, high, inner), patches + grain)
    return np.asarray(colour, dtype=np.float32)


def _markings(
    look: _Look, colour: Any, x: Plane, y: Plane, footprint: Plane, way: tuple[float, float, list[float]], wear: Plane
) -> Any:
    low, high, inner = way
    dash, period, phase = look.dash

    def stripe(at: float, width: float) -> Any:
        return _soft(y - (at - width / 2), footprint) * _soft(at + width / 2 - y, footprint)

    cover = np.maximum(stripe(low, 0.20), stripe(high, 0.20))
    along = np.mod(x + np.float32(phase), np.float32(period))
    long = footprint * 6
    dashes = _soft(along, long) * _soft(dash - along, long)
    for at in inner:
        cover = np.maximum(cover, stripe(at, 0.13) * dashes)
    cover = np.clip(cover * np.clip(0.9 - 0.12 * wear, 0.3, 1), 0, 1)[..., None]
    return colour * (1 - cover) + look.white * cover


def _wet(scene: Scene, light: Light, look: _Look, radiance: Any, x: Plane, y: Plane) -> Any:
    """Sky mirrored in a film of water, more the flatter one looks."""
    height = scene.camera.height_m
    cosine = height / np.sqrt(x * x + y * y + height**2)
    film = 0.85 + 0.12 * np.clip(_lookup(look.patches, x * 0.2, y, 26.0), -1, 1)
    paved = np.zeros_like(y)
    for low, high, _ in _carriageways(scene):
        paved = np.maximum(paved, _soft(y - low + look.shoulder, 0.3) * _soft(high + look.shoulder - y, 0.3))
    share = np.clip((0.02 + 0.5 * (1 - cosine) ** 5) * film * paved, 0, 1).astype(np.float32)[..., None]
    return radiance * (1 - share) + light.sky_low.astype(np.float32) * share


def _trees(scene: Scene, light: Light, look: _Look, radiance: Any, rays: list[Plane], side: float) -> Any:
    """A row of bushes and trees along the road at y = side, as an upright screen of leaves."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.float32(side) / rays[1]
        hit_x, hit_z = t * rays[0], np.float32(scene.camera.height_m) + t * rays[2]
        behind = ~((t > 0) & (hit_z > 0) & (np.abs(hit_x) < 700))
    hit_x, hit_z = np.where(behind, np.float32(0), hit_x), np.where(behind, np.float32(0), hit_z)
    ragged = 0.5 * _lookup(look.leaves, hit_x * 1.7, hit_z, 23.0)
    tall = look.trees_m * (1 + 0.22 * _lookup(look.crowns, hit_x, np.full_like(hit_x, abs(side)), 90.0)) + ragged
    seen = ~behind & (hit_z < tall)
    if not seen.any():
        return radiance
    footprint = np.abs(t) * np.float32(1 / _SS)
    clumps = _lookup(look.leaves, hit_x, hit_z * 0.9, 30.0)
    leaves = _lookup(look.leaves, hit_x, hit_z, 8.0) * np.clip(0.10 / np.maximum(footprint, 1e-3), 0, 1)
    depth = np.clip(0.35 + 0.75 * hit_z / tall, 0.3, 1.1)
    tone = np.array([0.045, 0.062, 0.020], dtype=np.float32) * (light.sun * 0.6 + light.ambient).astype(np.float32)
    shaded = tone * (depth * np.exp(0.42 * clumps + 0.38 * leaves))[..., None]
    return np.where(seen[..., None], shaded.astype(np.float32), radiance)


def _guard_rails(scene: Scene, light: Light, image: Plane) -> Plane:
    """Rails on posts along the measured carriageway, not between the carriageways."""
    camera = scene.camera
    ways = _carriageways(scene)
    low, high, _ = ways[0]
    beside = [low - 2.9, high + 2.9]
    if len(ways) == 2:
        beside = beside[1:] if ways[1][0] < low else beside[:1]
    rails = []
    for y in beside:
        for x in np.arange(2.0, 160.0, 4.0):
            rails.append(box_mesh((x, y - 0.03, 0.45), (x + 4.0, y + 0.03, 0.75)))
            rails.append(box_mesh((x, y - 0.05, 0.0), (x + 0.1, y + 0.05, 0.55)))
    mesh = join(rails)
    depth = (mesh.vertices - np.array([0.0, 0.0, camera.height_m])) @ camera.axes[:, 2]
    pixels = np.nan_to_num(camera.project(mesh.vertices), nan=-1e6)
    screen = np.concatenate([pixels, np.where(depth > 1, depth, -1.0)[:, None]], axis=1)
    assert camera.image_wh is not None
    ids = visible_triangles(screen, mesh.triangles, camera.image_wh, (0.0, 0.0), _SS, True)
    normals = mesh.normals.mean(axis=1)
    lit = np.clip(normals @ light.sun_direction, 0, 1)[:, None] * light.sun
    lit = lit + (0.5 + 0.5 * normals[:, 2:]) * light.ambient
    tone = to_grey_levels(np.array([0.30, 0.31, 0.32]) * lit * light.exposure)[:, ::-1]
    cover = (ids >= 0).astype(np.float32)[..., None]
    size = camera.image_wh
    painted = cv2.resize(tone[np.maximum(ids, 0)] * cover, size, interpolation=cv2.INTER_AREA)
    left = 1 - cv2.resize(cover, size, interpolation=cv2.INTER_AREA)[..., None]
    return np.asarray(image * left + painted, dtype=np.float32)
