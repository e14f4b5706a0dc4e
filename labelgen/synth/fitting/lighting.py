"""Light and exposure fitted to a picture: to its road, to shadows in its video, to the real vehicles on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.fitting.footage import Footage
from labelgen.synth.fitting.sun import NEAR_SHADOW, Shadows
from labelgen.synth.sensor.sensor import Sensor
from labelgen.synth.shading.lighting import Light

__all__ = [
    "Part",
    "Tones",
    "fit_to_details",
    "fit_to_road",
    "fit_to_shadows",
    "fit_to_tones",
    "footage_parts",
    "tones_of",
]

_LEAST_SIDE, _PER_VEHICLE, _FEWEST = 20, 500, 6
_PALE, _NEARLY_GREY, _FEWEST_PX = 140, 45, 40
_MOST_COLOUR, _CALM, _BRIGHT = 1.8, 0.7, 190.0
_PERCENTILES = (4.0, 50.0, 98.5)
_WEIGHTS = (0.9, 0.5, 0.9)
"""How far brightness follows the video at these percentiles: what drives there decides most on the middle one."""
_STEEPEST = 1.9
_ALL_DARK = 0.9
_ABOVE_FOOT, _BESIDE = 0.75, 0.15
"""Which part of a vehicle's height, and how much of its width on either side, does not count for its brightness."""
_LEAST_SKY, _SEEN_SKY = 0.08, 0.65
_OFF_EDGES, _SHARPEST_PX = 0.6, 0.3
"""How far sharpening that suits vehicles may lie from what edges show."""
_MOST_COARSER = 1.7

Mask = NDArray[np.bool_]


def fit_to_road(light: Light, background: NDArray[np.uint8], mask: Mask) -> Light:
    """The light under which asphalt of ordinary albedo looks like this road.

    Args:
        light: kind of light.
        background: (H, W, 3) uint8 BGR, the empty road.
        mask: (H, W) where it is road.
    """
    level = np.median(background[mask], axis=0)[::-1] / 255.0
    target = np.clip(level, 0.03, 0.9) ** 2.2
    plain = light.road_radiance * light.exposure
    # Brightness goes into the exposure; of the tint, part may be the road's own colour, so only half goes to the light.
    exposure = float(np.clip(target.mean() / plain.mean(), 0.5, 2.2))
    ratio = target / plain / (target / plain).mean()
    tint = np.sqrt(ratio)
    return replace(
        light,
        exposure=light.exposure * exposure,
        sun=light.sun * tint,
        sky_low=light.sky_low * tint,
        sky_high=light.sky_high * tint,
        horizon=light.horizon * tint,
        road=light.road * tint,
        noise=min(light.noise, 2.0),
    )


def fit_to_shadows(light: Light, shadows: Shadows) -> Light:
    """The light with the sun where shadows say it stands, and a sky that leaves them as dark as they are.

    Args:
        light: of a sunny kind where `shadows.sunny`.
        shadows: of the video's vehicles.
    """
    if shadows.sun is not None:
        light = replace(light, sun_direction=shadows.sun)
    if shadows.left is None or not shadows.sunny:
        return light
    shares = np.linspace(0, 1, 201)
    seen = light.grey_levels(shares[:, None] * light.road_radiance).mean(axis=1)
    # The vehicle that casts the shadow hides part of the sky as well.
    sky = float(np.clip(np.interp(shadows.left * seen[-1], seen, shares) / _SEEN_SKY, _LEAST_SKY, 1.0))
    total = float(light.road_radiance.mean())
    sun = light.sun * max(light.sun_direction[2], 0.05) * light.road
    up, down = (sky * total / float((light.road * light.ambient).mean()), (1 - sky) * total / float(sun.mean()))
    return replace(light, sun=light.sun * down, sky_low=light.sky_low * up, sky_high=light.sky_high * up)


@dataclass(frozen=True, eq=False)
class Tones:
    """Brightness and colours of vehicles in pictures.

    Args:
        grey: levels at `_PERCENTILES`.
        colour: how far the most colourful twentieth of a vehicle is from its usual colour, grey levels; of vehicles
            the middle one. Lamps and plates decide, which all have: what colours drive by is chance.
        cast: (2,) by how much blue and red exceed green on pale grey panels, grey levels; zeros where none are seen.
        fine: contrast of details of about a pixel, as a share of that of details of a few pixels.
        vehicles: how many there were.
    """

    grey: tuple[float, ...]
    colour: float
    cast: tuple[float, ...]
    fine: float
    vehicles: int


Part = tuple[NDArray[np.uint8], Mask]
"""A piece of a frame (h, w, 3) BGR, and which of its pixels show a vehicle."""


def tones_of(parts: Sequence[Part]) -> Tones | None:
    """The tones of vehicles, each of which counts alike; None for too few."""
    if len(parts) < _FEWEST:
        return None
    pixels = [image[mask] for image, mask in parts]
    inner = [image[_core(mask)] for image, mask in parts]
    picked = np.concatenate([p[np.linspace(0, len(p) - 1, _PER_VEHICLE).astype(int)] for p in inner if len(p)])
    grey = tuple(np.percentile(cv2.cvtColor(picked[None], cv2.COLOR_BGR2GRAY), _PERCENTILES).tolist())
    colour = float(np.median([_colour(p) for p in pixels]))
    casts = [cast for cast in map(_cast, pixels) if cast is not None]
    cast = tuple(np.median(casts, axis=0).tolist()) if len(casts) >= _FEWEST else (0.0, 0.0)
    fine = float(np.median([_fine(image, mask) for image, mask in parts]))
    return Tones(grey, colour, cast, fine, len(parts))


def _core(mask: Mask) -> Mask:
    """What of a vehicle lies well inside its outline: the shadow at its foot may be taken for a part of it."""
    height, width = mask.shape
    out = mask.copy()
    out[int(_ABOVE_FOOT * height) :] = False
    out[:, : int(_BESIDE * width)] = out[:, width - int(_BESIDE * width) :] = False
    return out if out.any() else mask


def _colour(pixels: NDArray[np.uint8]) -> float:
    chroma = cv2.cvtColor(pixels[None], cv2.COLOR_BGR2YCrCb)[0, :, 1:].astype(np.float64)
    return float(np.percentile(np.hypot(*(chroma - np.median(chroma, axis=0)).T), 95))


def _cast(pixels: NDArray[np.uint8]) -> NDArray[np.float64] | None:
    """Blue and red less green where a vehicle is pale; None where it is dark or coloured."""
    levels = pixels.astype(np.float64)
    pale = levels[(levels.min(axis=1) > _PALE) & (np.ptp(levels, axis=1) < _NEARLY_GREY) & (levels.max(axis=1) < 250)]
    if len(pale) < max(_FEWEST_PX, 0.1 * len(levels)):
        return None
    return np.asarray((pale[:, [0, 2]] - pale[:, 1:2]).mean(axis=0))


def _fine(image: NDArray[np.uint8], mask: Mask) -> float:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    soft, softer = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1.0, 3.0))
    return float(np.abs(grey - soft)[mask].mean() / max(float(np.abs(soft - softer)[mask].mean()), 0.1))


def footage_parts(
    footage: Footage, road: Mask, shadows: Shadows, known: Sequence[Mask] | None = None
) -> Iterator[Part]:
    """A video's vehicles, as far as they differ from the road.

    Args:
        footage: of the video.
        road: (H, W) where to look.
        shadows: of its vehicles, which are left out.
        known: (H, W) for each look, where vehicles are; to be found out when None.
    """
    empty = cv2.cvtColor(footage.empty, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1
    for number, look in enumerate(footage.looks):
        change = footage.changed(look) & (road if known is None else road & known[number])
        dark = np.zeros_like(change)
        if shadows.sunny:
            assert shadows.left is not None
            ratio = (cv2.cvtColor(look, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1) / empty
            mean = cv2.blur(ratio, (3, 3))
            even = cv2.blur(ratio * ratio, (3, 3)) - mean * mean < 0.05**2
            change &= ~(even & (np.abs(ratio - shadows.left) < NEAR_SHADOW))
            dark = ratio < shadows.left + NEAR_SHADOW
        inner = cv2.erode(change.astype(np.uint8), np.ones((5, 5), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(inner)
        for k in range(1, count):
            x, y, w, h, area = (int(v) for v in stats[k])
            if min(w, h) >= _LEAST_SIDE and area > 0.35 * w * h:
                part = labels[y : y + h, x : x + w] == k
                # The darkest part of a shadow, below a vehicle, is none; the darkest vehicle has lamps and gleams.
                if np.count_nonzero(part & dark[y : y + h, x : x + w]) < _ALL_DARK * area:
                    yield look[y : y + h, x : x + w], part


def fit_to_tones(light: Light, real: Tones, drawn: Tones) -> Light:
    """The light through a camera that makes of drawn vehicles what it makes of real ones.

    Args:
        light: as they were drawn.
        real: of the video's vehicles.
        drawn: of vehicles drawn in this light.
    """
    steps = [(d, d + weight * (r - d)) for r, d, weight in zip(real.grey, drawn.grey, _WEIGHTS, strict=True)]
    (low, to_low), (middle, to_middle), (high, to_high) = steps
    # Levels keep their order, and none is drawn apart so far that bands would show.
    slope = np.clip((to_high - to_low) / max(high - low, 1.0), 1 / _STEEPEST, _STEEPEST)
    to_middle = float(
        np.clip(to_middle, to_low + (middle - low) * slope / 1.5, to_high - (high - middle) * slope / 1.5)
    )
    dark = float(np.clip(to_low - low * slope, 0, to_low))
    bright = float(np.clip(to_high + (255 - high) * slope, to_high, 255))
    tone = ((0.0, dark), (low, to_low), (middle, to_middle), (high, to_high), (255.0, bright))
    colour = float(np.clip((real.colour / max(drawn.colour, 1.0)) ** 0.6, 0.4, 1.6))
    saturation = float(min(light.saturation * colour, _MOST_COLOUR))
    levels = np.linspace(0, 255, 18)
    before = light.toned(levels)
    rising = np.array(_rising(tone))
    after = np.interp(before, rising[:, 0], rising[:, 1])
    pairs = tuple(zip(levels.tolist(), after.tolist(), strict=True))
    return _balanced(replace(light, tone=pairs, saturation=saturation), real, drawn)


def _balanced(light: Light, real: Tones, drawn: Tones) -> Light:
    """The light through a camera that gives pale panels the tint that they have in the video."""
    if not any(real.cast) or not any(drawn.cast):
        return light
    blue, red = (1 + _CALM * (want - got) / _BRIGHT for want, got in zip(real.cast, drawn.cast, strict=True))
    factors = np.array(light.balance) * [red, 1.0, blue]
    return replace(light, balance=tuple((factors / factors.mean()).clip(0.85, 1.15).tolist()))


def fit_to_details(sensor: Sensor, measured: Sensor, real: Tones, drawn: Tones) -> Sensor:
    """The camera, sharpened until drawn vehicles show as fine details as real ones, as far as its edges allow.

    Args:
        sensor: as they were drawn.
        measured: on edges.
        real, drawn: as for `fit_to_tones`.
    """
    wanted = (1 + sensor.sharpen) * real.fine / max(drawn.fine, 1e-3) - 1
    low, high = max(0.0, measured.sharpen - _OFF_EDGES), measured.sharpen + _OFF_EDGES
    # Where halos would grow too strong, the lens must be sharper.
    blur = _SHARPEST_PX if wanted > high + _OFF_EDGES else measured.blur_px
    # What then is still missing are the dots that an old recorder's rounding leaves.
    coarser = float(np.clip((1 + wanted) / (1 + high), 1.0, _MOST_COARSER))
    return replace(
        sensor, blur_px=blur, sharpen=float(np.clip(wanted, low, high)), block_step=measured.block_step * coarser
    )


def _rising(tone: Any) -> tuple[tuple[float, float], ...]:
    """The steps with both values rising."""
    out = [tone[0]]
    for level, value in tone[1:]:
        if level > out[-1][0] + 0.5:
            out.append((level, max(value, out[-1][1])))
    return tuple(out)
