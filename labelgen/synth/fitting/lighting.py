"""Light, exposure and tone curve fitted to a video: to its road, its shadows and its vehicles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.fitting.footage import Footage
from labelgen.synth.fitting.sun import SUN, Shadows
from labelgen.synth.sensor.sensor import Sensor
from labelgen.synth.shading.lighting import Light

__all__ = [
    "LIGHTING",
    "LightingThresholds",
    "Tones",
    "VehiclePart",
    "fit_to_details",
    "fit_to_road",
    "fit_to_shadows",
    "fit_to_tones",
    "tones_of",
    "vehicle_parts",
]

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class LightingThresholds:
    """Thresholds for comparing rendered vehicles with those of a video.

    Args:
        min_side_px: least width and height of a part of a vehicle.
        pixels_per_vehicle: pixels drawn from each vehicle, so that all count alike.
        min_vehicles: vehicles below which nothing is fitted.
        percentiles: of brightness, at which tones are compared.
        weights: how far brightness follows the video at these percentiles. The middle one depends most on the colours
            of the cars that happened to drive there.
        pale_levels, grey_range, min_pale_px: grey level above which a panel is pale, difference of its channels below
            which it is grey, and pixels it must have.
        max_saturation: greatest saturation.
        tint_share, pale_reference: share of the panels' tint that the light takes over, and the grey level to which it
            refers.
        max_slope: steepest tone curve. A steeper one shows bands.
        shadow_spread: see `SunThresholds`.
        dark_share: share of dark pixels from which a part is shadow rather than a vehicle.
        top_share, side_share: which part of a vehicle's height counts for its brightness, and how much of its width on
            either side does not: its foot may be shadow.
        min_sky, seen_sky: least share of the light that comes from the sky, and the share of the sky that a vehicle's
            shadow still receives.
        edge_slack: how far sharpening may depart from what edges show.
        sharpest_px: lens blur where strong halos would be needed otherwise, px.
        max_coarser: greatest factor on the measured block step.
    """

    min_side_px: int = 20
    pixels_per_vehicle: int = 500
    min_vehicles: int = 6
    percentiles: tuple[float, float, float] = (4.0, 50.0, 98.5)
    weights: tuple[float, float, float] = (0.9, 0.5, 0.9)
    pale_levels: int = 140
    grey_range: int = 45
    min_pale_px: int = 40
    max_saturation: float = 1.8
    tint_share: float = 0.7
    pale_reference: float = 190.0
    max_slope: float = 1.9
    shadow_spread: float = SUN.shadow_spread
    dark_share: float = 0.9
    top_share: float = 0.75
    side_share: float = 0.15
    min_sky: float = 0.08
    seen_sky: float = 0.65
    edge_slack: float = 0.6
    sharpest_px: float = 0.3
    max_coarser: float = 1.7


LIGHTING = LightingThresholds()


def fit_to_road(light: Light, background: NDArray[np.uint8], mask: Mask) -> Light:
    """Return the light under which asphalt of ordinary albedo looks like this road.

    Args:
        light: kind of light.
        background: (H, W, 3) uint8 BGR, the road without traffic.
        mask: (H, W) road mask.
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


def fit_to_shadows(light: Light, shadows: Shadows, thresholds: LightingThresholds = LIGHTING) -> Light:
    """Return the light with the sun's direction and the share of skylight that the shadows show.

    Args:
        light: of a sunny kind where `shadows.sunny`.
        shadows: of the video's vehicles.
        thresholds: of this stage.
    """
    if shadows.sun is not None:
        light = replace(light, sun_direction=shadows.sun)
    if shadows.left is None or not shadows.sunny:
        return light
    shares = np.linspace(0, 1, 201)
    levels = light.grey_levels(shares[:, None] * light.road_radiance).mean(axis=1)
    # The vehicle that casts the shadow hides part of the sky as well.
    lit = np.interp(shadows.left * levels[-1], levels, shares)
    sky = float(np.clip(lit / thresholds.seen_sky, thresholds.min_sky, 1.0))
    total = float(light.road_radiance.mean())
    sun = light.sun * max(light.sun_direction[2], 0.05) * light.road
    up, down = (sky * total / float((light.road * light.ambient).mean()), (1 - sky) * total / float(sun.mean()))
    return replace(light, sun=light.sun * down, sky_low=light.sky_low * up, sky_high=light.sky_high * up)


@dataclass(frozen=True, eq=False)
class Tones:
    """Brightness and colours of vehicles in pictures.

    Args:
        grey: grey levels at `LightingThresholds.percentiles`.
        colour: distance of a vehicle's most colourful twentieth from its median colour, grey levels; the median over
            vehicles. Lamps and plates decide it, which all vehicles have; their paint varies by chance.
        cast: (2,) by how much blue and red exceed green on pale grey panels, grey levels; zeros without such panels.
        fine: contrast of details of about one pixel, as a share of that of details of a few pixels.
        vehicles: how many were measured.
    """

    grey: tuple[float, ...]
    colour: float
    cast: tuple[float, ...]
    fine: float
    vehicles: int


VehiclePart = tuple[NDArray[np.uint8], Mask]
"""A window of a frame (h, w, 3) uint8 BGR, and (h, w) bool which of its pixels show a vehicle."""


def tones_of(parts: Sequence[VehiclePart], thresholds: LightingThresholds = LIGHTING) -> Tones | None:
    """Return the tones of vehicles, each of which counts alike; None for too few."""
    if len(parts) < thresholds.min_vehicles:
        return None
    pixels = [image[mask] for image, mask in parts]
    inner = [image[_core(mask, thresholds)] for image, mask in parts]
    count = thresholds.pixels_per_vehicle
    picked = np.concatenate([p[np.linspace(0, len(p) - 1, count).astype(int)] for p in inner if len(p)])
    grey = tuple(np.percentile(cv2.cvtColor(picked[None], cv2.COLOR_BGR2GRAY), thresholds.percentiles).tolist())
    colour = float(np.median([_colour(p) for p in pixels]))
    casts = [cast for cast in (_cast(p, thresholds) for p in pixels) if cast is not None]
    cast = tuple(np.median(casts, axis=0).tolist()) if len(casts) >= thresholds.min_vehicles else (0.0, 0.0)
    fine = float(np.median([_fine(image, mask) for image, mask in parts]))
    return Tones(grey, colour, cast, fine, len(parts))


def _core(mask: Mask, thresholds: LightingThresholds) -> Mask:
    """Return the pixels well inside a vehicle's outline: the shadow at its foot may belong to the mask."""
    height, width = mask.shape
    out = mask.copy()
    out[int(thresholds.top_share * height) :] = False
    out[:, : int(thresholds.side_share * width)] = out[:, width - int(thresholds.side_share * width) :] = False
    return out if out.any() else mask


def _colour(pixels: NDArray[np.uint8]) -> float:
    chroma = cv2.cvtColor(pixels[None], cv2.COLOR_BGR2YCrCb)[0, :, 1:].astype(np.float64)
    return float(np.percentile(np.hypot(*(chroma - np.median(chroma, axis=0)).T), 95))


def _cast(pixels: NDArray[np.uint8], thresholds: LightingThresholds) -> NDArray[np.float64] | None:
    """Return blue and red less green where a vehicle is pale; None where it is dark or coloured."""
    levels = pixels.astype(np.float64)
    grey = (levels.min(axis=1) > thresholds.pale_levels) & (np.ptp(levels, axis=1) < thresholds.grey_range)
    pale = levels[grey & (levels.max(axis=1) < 250)]
    if len(pale) < max(thresholds.min_pale_px, 0.1 * len(levels)):
        return None
    return np.asarray((pale[:, [0, 2]] - pale[:, 1:2]).mean(axis=0))


def _fine(image: NDArray[np.uint8], mask: Mask) -> float:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    soft, softer = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1.0, 3.0))
    return float(np.abs(grey - soft)[mask].mean() / max(float(np.abs(soft - softer)[mask].mean()), 0.1))


def vehicle_parts(
    footage: Footage,
    road: Mask,
    shadows: Shadows,
    masks: Sequence[Mask] | None = None,
    thresholds: LightingThresholds = LIGHTING,
) -> Iterator[VehiclePart]:
    """Yield the parts of a video's vehicles that differ from the road, without their shadows.

    Args:
        footage: of the video.
        road: (H, W) road mask.
        shadows: of its vehicles.
        masks: (H, W) for each frame, where vehicles are; everywhere when None.
        thresholds: of this stage.
    """
    background = cv2.cvtColor(footage.background, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1
    for number, frame in enumerate(footage.frames):
        foreground = footage.foreground(frame) & (road if masks is None else road & masks[number])
        dark = np.zeros_like(foreground)
        if shadows.sunny:
            assert shadows.left is not None
            ratio = (cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1) / background
            mean = cv2.blur(ratio, (3, 3))
            even = cv2.blur(ratio * ratio, (3, 3)) - mean * mean < 0.05**2
            foreground &= ~(even & (np.abs(ratio - shadows.left) < thresholds.shadow_spread))
            dark = ratio < shadows.left + thresholds.shadow_spread
        inner = cv2.erode(foreground.astype(np.uint8), np.ones((5, 5), np.uint8))
        count, labels, stats, _ = cv2.connectedComponentsWithStats(inner)
        for k in range(1, count):
            x, y, w, h, area = (int(v) for v in stats[k])
            if min(w, h) >= thresholds.min_side_px and area > 0.35 * w * h:
                part = labels[y : y + h, x : x + w] == k
                # The dark core of a shadow below a vehicle is no vehicle; the darkest vehicle has lamps and highlights.
                if np.count_nonzero(part & dark[y : y + h, x : x + w]) < thresholds.dark_share * area:
                    yield frame[y : y + h, x : x + w], part


def fit_to_tones(light: Light, real: Tones, drawn: Tones, thresholds: LightingThresholds = LIGHTING) -> Light:
    """Return the light with a tone curve, saturation and balance that give rendered vehicles the tones of real ones.

    Args:
        light: in which the vehicles were rendered.
        real: of the video's vehicles.
        drawn: of vehicles rendered in this light.
        thresholds: of this stage.
    """
    steps = [(d, d + weight * (r - d)) for r, d, weight in zip(real.grey, drawn.grey, thresholds.weights, strict=True)]
    (low, to_low), (middle, to_middle), (high, to_high) = steps
    # Levels keep their order, and none is spread so far that bands would show.
    slope = np.clip((to_high - to_low) / max(high - low, 1.0), 1 / thresholds.max_slope, thresholds.max_slope)
    to_middle = float(
        np.clip(to_middle, to_low + (middle - low) * slope / 1.5, to_high - (high - middle) * slope / 1.5)
    )
    dark = float(np.clip(to_low - low * slope, 0, to_low))
    bright = float(np.clip(to_high + (255 - high) * slope, to_high, 255))
    tone = ((0.0, dark), (low, to_low), (middle, to_middle), (high, to_high), (255.0, bright))
    colour = float(np.clip((real.colour / max(drawn.colour, 1.0)) ** 0.6, 0.4, 1.6))
    saturation = float(min(light.saturation * colour, thresholds.max_saturation))
    levels = np.linspace(0, 255, 18)
    before = light.toned(levels)
    rising = np.array(_rising(tone))
    after = np.interp(before, rising[:, 0], rising[:, 1])
    pairs = tuple(zip(levels.tolist(), after.tolist(), strict=True))
    return _balanced(replace(light, tone=pairs, saturation=saturation), real, drawn, thresholds)


def _balanced(light: Light, real: Tones, drawn: Tones, thresholds: LightingThresholds) -> Light:
    """Return the light with a white balance that gives pale panels the tint that they have in the video."""
    if not any(real.cast) or not any(drawn.cast):
        return light
    blue, red = (
        1 + thresholds.tint_share * (want - got) / thresholds.pale_reference
        for want, got in zip(real.cast, drawn.cast, strict=True)
    )
    factors = np.array(light.balance) * [red, 1.0, blue]
    return replace(light, balance=tuple((factors / factors.mean()).clip(0.85, 1.15).tolist()))


def fit_to_details(
    sensor: Sensor, measured: Sensor, real: Tones, drawn: Tones, thresholds: LightingThresholds = LIGHTING
) -> Sensor:
    """Return the sensor with the sharpening that gives rendered vehicles the fine detail of real ones.

    Args:
        sensor: with which the vehicles were rendered.
        measured: on the video's edges; the sharpening stays near it.
        real, drawn: as for `fit_to_tones`.
        thresholds: of this stage.
    """
    wanted = (1 + sensor.sharpen) * real.fine / max(drawn.fine, 1e-3) - 1
    low, high = max(0.0, measured.sharpen - thresholds.edge_slack), measured.sharpen + thresholds.edge_slack
    # Where halos would grow too strong, the lens must be sharper.
    blur = thresholds.sharpest_px if wanted > high + thresholds.edge_slack else measured.blur_px
    # The remaining detail comes from the coarse quantisation of an old codec.
    coarser = float(np.clip((1 + wanted) / (1 + high), 1.0, thresholds.max_coarser))
    return replace(
        sensor, blur_px=blur, sharpen=float(np.clip(wanted, low, high)), block_step=measured.block_step * coarser
    )


def _rising(tone: Any) -> tuple[tuple[float, float], ...]:
    """Return the steps of a tone curve with both values rising."""
    out = [tone[0]]
    for level, value in tone[1:]:
        if level > out[-1][0] + 0.5:
            out.append((level, max(value, out[-1][1])))
    return tuple(out)
