"""Draw the picture of a made-up empty road: asphalt, markings, verge, props, woods and sky."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.scene.placement import place_props
from labelgen.synth.scene.road_markings import Surface, draw_surface
from labelgen.synth.scene.scene import RoadScene, carriageways
from labelgen.synth.scene.static_layer import (
    NO_SHADE,
    Shade,
    StaticLayer,
    draw_props,
    draw_shade,
    without_view_blockers,
)
from labelgen.synth.scene.strips import strips
from labelgen.synth.shading.lighting import Light, Weather

__all__ = ["draw_road", "draw_scene"]

_TILE = 512
"""Side of a noise tile, cells."""
_STRIP = 48
"""Rows painted at once: more need more memory."""
_SS = 2
"""Samples per pixel and side."""
_BLUR_REACH = 4
"""Pixels around a window that are painted too, since the last blur mixes them in."""
Plane = NDArray[np.float32]


def _noise_tile(rng: np.random.Generator, cells: tuple[float, ...]) -> Plane:
    """Return (512, 512) noise that repeats, of zero mean and unit deviation: white noise blurred at several scales."""
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


@dataclass(frozen=True, eq=False)
class _Style:
    """What varies from picture to picture: noise tiles, colours, wear and distances."""

    grain: Plane
    patches: Plane
    grass: Plane
    crowns: Plane
    leaves: Plane
    verge: Plane
    dry: Plane
    bare: float
    paint: Plane
    edge_paint: Plane
    shoulder: float
    tracks: tuple[float, float]
    dash: tuple[float, float, float]
    woods: tuple[tuple[float, float], ...]


_VERGES = (
    ((0.055, 0.085, 0.022), (0.16, 0.135, 0.075), 0.5),
    ((0.16, 0.135, 0.085), (0.24, 0.20, 0.14), 0.2),
    ((0.20, 0.19, 0.18), (0.25, 0.24, 0.22), 0.2),
    ((0.085, 0.10, 0.040), (0.26, 0.22, 0.13), 0.1),
)
"""Colours of the ground beside roads and how common they are: grass, earth, paving, dry grass."""


def _sample_style(scene: RoadScene, rng: np.random.Generator) -> _Style:
    borders = carriageways(scene)
    dash, period = ((3.0, 9.0), (6.0, 18.0), (3.0, 12.0), (4.0, 10.0))[int(rng.integers(4))]
    ground, dry, _ = _VERGES[int(rng.choice(len(_VERGES), p=[v[2] for v in _VERGES]))]
    white = np.array([0.62, 0.62, 0.59], dtype=np.float32) * np.float32(rng.uniform(0.6, 1.0))
    yellow = np.array([0.58, 0.36, 0.05], dtype=np.float32)
    sides = ((min(b[0] for b in borders), -1), (max(b[1] for b in borders), 1))
    woods = [(edge + side * rng.uniform(9, 34), rng.uniform(3.5, 11.0)) for edge, side in sides if rng.random() < 0.6]
    return _Style(
        _noise_tile(rng, (0.0, 1.0)),
        _noise_tile(rng, (4.0, 16.0, 40.0)),
        _noise_tile(rng, (0.7, 2.0, 8.0)),
        _noise_tile(rng, (1.0, 3.0, 9.0)),
        _noise_tile(rng, (0.8, 2.5, 6.0)),
        np.array(ground, dtype=np.float32) * np.float32(rng.uniform(0.7, 1.3)),
        np.array(dry, dtype=np.float32),
        rng.uniform(0.1, 0.9),
        white,
        yellow if rng.random() < 0.25 else white,
        rng.uniform(0.3, 2.8),
        (rng.uniform(0.0, 0.12), rng.uniform(0.02, 0.16) if rng.random() < 0.7 else rng.uniform(0.15, 0.45)),
        (dash, period, rng.uniform(0, period)),
        tuple(woods),
    )


def draw_road(scene: RoadScene, light: Light, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw the empty road of a procedural scene without props: (H, W, 3) uint8 BGR."""
    style, surface = _sample_style(scene, rng), draw_surface(scene, rng)
    return _finished(_painted(scene, light, style, surface, NO_SHADE))


def draw_scene(
    scene: RoadScene, light: Light, rng: np.random.Generator, windows_xyxy: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.uint8], StaticLayer | None]:
    """Draw the empty road of a procedural scene with all that stands beside it.

    Args:
        scene: from `procedural_scene`.
        light: of the picture.
        rng: decides what the road and its surroundings style like.
        windows_xyxy: (N, 4) px, the parts of the picture that are needed; the rest may stay black. None for all of it.

    Returns:
        (H, W, 3) uint8 BGR, and what of it may hide vehicles; None when nothing stands there.
    """
    style, surface = _sample_style(scene, rng), draw_surface(scene, rng)
    props = without_view_blockers(scene, place_props(scene, style.shoulder, rng))
    shade = draw_shade(scene, light, props)
    if windows_xyxy is not None:  # so that the last blur finds painted neighbours everywhere
        windows_xyxy = windows_xyxy + np.array([-_BLUR_REACH, -_BLUR_REACH, _BLUR_REACH, _BLUR_REACH])
    road = _painted(scene, light, style, surface, shade, windows_xyxy)
    image, static_layer = draw_props(road, scene.camera, light, props, shade, windows_xyxy)
    return _finished(image), static_layer


def _painted(
    scene: RoadScene, light: Light, style: _Style, surface: Surface, shade: Shade,
    windows_xyxy: NDArray[np.int64] | None = None,
) -> Plane:  # fmt: skip
    assert scene.camera.image_wh is not None
    width, height = scene.camera.image_wh
    image = np.zeros((height, width, 3), dtype=np.float32)
    for rows, columns in strips((width, height), _STRIP, windows_xyxy):
        x, y = _sample_places(columns)[None], _sample_places(rows)[:, None]
        levels = light.grey_levels(_strip(scene, light, style, surface, shade, x, y))
        size = (columns.stop - columns.start, rows.stop - rows.start)
        image[rows, columns] = cv2.resize(levels[..., ::-1], size, interpolation=cv2.INTER_AREA)
    return image


def _sample_places(pixels: slice) -> NDArray[np.float64]:
    """Places of the samples of a run of pixels, frame px."""
    count = _SS * (pixels.stop - pixels.start)
    return np.asarray(pixels.start + (np.arange(count) + 0.5) / _SS)


def _finished(image: Plane) -> NDArray[np.uint8]:
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.55), 0, 255).astype(np.uint8)


def _strip(
    scene: RoadScene,
    light: Light,
    style: _Style,
    surface: Surface,
    shade: Shade,
    columns: NDArray[Any],
    rows: NDArray[Any],
) -> Plane:
    """Return the linear RGB radiance (h, w, 3) of samples at columns (1, w) and rows (h, 1), frame px."""
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
    sun = (light.sun * max(light.sun_direction[2], 0.0)).astype(np.float32)
    ambient = light.ambient.astype(np.float32)
    in_sun, under_sky = shade.at(shade.sun, x, y), shade.at(shade.sky, x, y)
    albedo = _ground(scene, light, style, surface, x, y, footprint)
    planes = [albedo[k] * (sun[k] * in_sun + ambient[k] * under_sky) for k in range(3)]
    if light.weather is Weather.RAIN:
        planes = _wet(scene, light, style, planes, x, y)
    radiance = np.stack(planes, axis=-1)
    radiance = light.through_air(radiance, np.sqrt(x * x + y * y + np.float32(camera.height_m**2))[..., None])
    if sky.any():
        climb = np.clip(rays[2] / np.float32(0.8 * camera.focal), 0, 1)[..., None]
        low, high = light.sky_low.astype(np.float32), light.sky_high.astype(np.float32)
        radiance = np.where(sky[..., None], low + (high - low) * np.sqrt(climb), radiance)
    for wood in style.woods:
        radiance = _woods(scene, light, style, radiance, rays, wood)
    return np.asarray(radiance, dtype=np.float32)


def _soft(value: Any, width: Any) -> Any:
    """Return a ramp from 0 to 1 around zero, as wide as `width`."""
    return np.clip(value / np.maximum(width, np.float32(1e-4)) + np.float32(0.5), 0, 1)


def _blend(planes: list[Any], layer: Any, share: Any) -> list[Any]:
    """Lay a layer over three planes; `share` of each pixel shows the layer, which is three planes or three values."""
    if not share.any():
        return planes
    left = 1 - share
    return [planes[k] * left + layer[k] * share for k in range(3)]


def _ground(
    scene: RoadScene, light: Light, style: _Style, surface: Surface, x: Plane, y: Plane, footprint: Plane
) -> list[Plane]:
    """Return the albedo of grass, gravel, asphalt and markings as planes of red, green and blue."""
    grain = _lookup(style.grain, x, y, 6.0) * np.clip(0.012 / footprint, 0, 1)
    patches = _lookup(style.patches, x, y * 2.5, 40.0) + 0.6 * _lookup(style.patches, x * 0.13, y, 17.0)
    mix = np.clip(style.bare + 0.25 * _lookup(style.patches, x, y, 23.0), 0, 1)
    blades = np.exp(0.35 * _lookup(style.grass, x, y, 9.0) * np.clip(0.05 / footprint, 0.15, 1))
    colour: list[Any] = [(style.verge[k] * (1 - mix) + style.dry[k] * mix) * blades for k in range(3)]
    road = light.road.astype(np.float32)
    rough, coarse = 1 + 0.10 * grain + 0.05 * patches, 1 + 0.18 * grain + 0.06 * patches
    asphalt = [road[k] * rough for k in range(3)]
    gravel = [tone * coarse for tone in np.array([0.21, 0.20, 0.18], dtype=np.float32)]
    shoulder = [plane * 1.08 for plane in asphalt]
    wear_of_paint = patches + grain
    for low, high, inner in carriageways(scene):
        for extra, layer in ((style.shoulder + 0.9, gravel), (style.shoulder, shoulder)):
            inside = _soft(y - (low - extra), footprint + 0.06) * _soft(high + extra - y, footprint + 0.06)
            colour = _blend(colour, layer, inside)
        inside = _soft(y - low + 0.3, footprint) * _soft(high + 0.3 - y, footprint)
        if not inside.any():
            continue
        worn = _wear_across(style, y, [low, *inner, high]) * inside
        left = 1 - inside
        colour = [colour[k] * left + asphalt[k] * worn for k in range(3)]
        colour = _markings(style, colour, x, y, footprint, (low, high, inner), wear_of_paint)
    lying, tone = surface.at(x, y, footprint)
    lying = lying * np.clip(0.85 - 0.12 * wear_of_paint, 0.2, 1)
    bare = 1 - lying
    return [np.asarray(colour[k] * tone * bare + style.paint[k] * lying, dtype=np.float32) for k in range(3)]


def _wear_across(style: _Style, y: Plane, lanes: list[float]) -> Plane:
    """Return a factor on asphalt: wheels polish two tracks per lane, oil drips between them."""
    step = 0.02
    at = np.arange(lanes[0] - 1.0, lanes[-1] + 1.0, step)
    profile = np.ones_like(at, dtype=np.float32)
    for a, b in pairwise(lanes):
        middle = (a + b) / 2
        for side in (-0.85, 0.85):
            profile += style.tracks[0] * np.exp(-(((at - middle - side) / 0.28) ** 2))
        profile -= style.tracks[1] * np.exp(-(((at - middle) / 0.45) ** 2))
    out: Plane = profile[((y - np.float32(at[0])) * np.float32(1 / step)).astype(np.int32).clip(0, len(at) - 1)]
    return out


def _markings(
    style: _Style, colour: Any, x: Plane, y: Plane, footprint: Plane, way: tuple[float, float, list[float]], wear: Plane
) -> Any:
    low, high, inner = way
    dash, period, phase = style.dash

    def stripe(at: float, width: float) -> Any:
        return _soft(y - (at - width / 2), footprint) * _soft(at + width / 2 - y, footprint)

    along = np.mod(x + np.float32(phase), np.float32(period))
    long = footprint * 6
    dashes = _soft(along, long) * _soft(dash - along, long)
    between = np.zeros_like(y)
    for at in inner:
        between = np.maximum(between, stripe(at, 0.13) * dashes)
    worn = np.clip(0.9 - 0.12 * wear, 0.3, 1)
    for cover, paint in ((np.maximum(stripe(low, 0.20), stripe(high, 0.20)), style.edge_paint), (between, style.paint)):
        colour = _blend(colour, paint, np.clip(cover * worn, 0, 1))
    return colour


def _wet(scene: RoadScene, light: Light, style: _Style, radiance: list[Any], x: Plane, y: Plane) -> list[Any]:
    """Add the sky mirrored in a film of water: the more, the flatter the angle of view."""
    height = scene.camera.height_m
    cosine = height / np.sqrt(x * x + y * y + height**2)
    film = 0.85 + 0.12 * np.clip(_lookup(style.patches, x * 0.2, y, 26.0), -1, 1)
    paved = np.zeros_like(y)
    for low, high, _ in carriageways(scene):
        paved = np.maximum(paved, _soft(y - low + style.shoulder, 0.3) * _soft(high + style.shoulder - y, 0.3))
    share = np.clip((0.02 + 0.5 * (1 - cosine) ** 5) * film * paved, 0, 1).astype(np.float32)
    return _blend(radiance, light.sky_low.astype(np.float32), share)


def _woods(
    scene: RoadScene, light: Light, style: _Style, radiance: Any, rays: list[Plane], wood: tuple[float, float]
) -> Any:
    """Add a row of bushes and trees along the road as an upright screen of leaves; `wood`: its y and height, metres."""
    side, high = wood
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.float32(side) / rays[1]
        hit_x, hit_z = t * rays[0], np.float32(scene.camera.height_m) + t * rays[2]
        behind = ~((t > 0) & (hit_z > 0) & (np.abs(hit_x) < 700))
    hit_x, hit_z = np.where(behind, np.float32(0), hit_x), np.where(behind, np.float32(0), hit_z)
    uneven = 0.5 * _lookup(style.leaves, hit_x * 1.7, hit_z, 23.0)
    tall = high * (1 + 0.22 * _lookup(style.crowns, hit_x, np.full_like(hit_x, abs(side)), 90.0)) + uneven
    hit = ~behind & (hit_z < tall)
    if not hit.any():
        return radiance
    footprint = np.abs(t) * np.float32(1 / _SS)
    clumps = _lookup(style.leaves, hit_x, hit_z * 0.9, 30.0)
    leaves = _lookup(style.leaves, hit_x, hit_z, 8.0) * np.clip(0.10 / np.maximum(footprint, 1e-3), 0, 1)
    depth = np.clip(0.35 + 0.75 * hit_z / tall, 0.3, 1.1)
    tone = np.array([0.045, 0.062, 0.020], dtype=np.float32) * (light.sun * 0.6 + light.ambient).astype(np.float32)
    shaded = tone * (depth * np.exp(0.42 * clumps + 0.38 * leaves))[..., None]
    far = np.sqrt(hit_x * hit_x + np.float32(side**2))[..., None]
    return np.where(hit[..., None], light.through_air(shaded.astype(np.float32), far), radiance)
