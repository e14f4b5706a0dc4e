"""Light of a recording: direction of the sun, radiance of sky and road, and the camera's tone curve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Light", "Weather", "make_light", "varied_light"]


_CURVE_STEPS = 1024
"""Entries of the tone curve per unit of linear light."""
_LUMA = np.array([0.30, 0.59, 0.11], dtype=np.float32)


class Weather(StrEnum):
    """Kinds of light."""

    DAY = "day"
    OVERCAST = "overcast"
    DUSK = "dusk"
    RAIN = "rain"


@dataclass(frozen=True, eq=False)
class Light:
    """The light of a recording, in linear RGB; white paint in the open is about 1 at exposure 1.

    Args:
        weather: kind of light.
        sun_direction: (3,) unit vector towards the sun, road frame.
        sun: (3,) irradiance on a surface that faces the sun; zero when it is hidden.
        sky_low, sky_high: (3,) radiance near the horizon and at the zenith.
        horizon: (3,) radiance of trees and houses.
        road: (3,) albedo of asphalt.
        exposure: factor before the tone curve.
        noise: standard deviation of the sensor's noise in grey levels.
        shutter_s: exposure time.
        lamps: whether vehicles have their lamps on.
        haze_per_m: extinction coefficient of the air, 1 / m; the lost light is replaced by that of the air.
        saturation: 1 keeps colours, 0 is grey.
        contrast: slope of the tone curve around middle grey.
        lift: grey level, 0 to 1, to which black is raised.
        tone: rising pairs of grey levels, a further tone curve; the identity when empty.
        balance: factors of red, green and blue after the tone curves: the white balance.
    """

    weather: Weather
    sun_direction: NDArray[np.float64]
    sun: NDArray[np.float64]
    sky_low: NDArray[np.float64]
    sky_high: NDArray[np.float64]
    horizon: NDArray[np.float64]
    road: NDArray[np.float64]
    exposure: float
    noise: float
    shutter_s: float
    lamps: bool
    haze_per_m: float = 0.0
    saturation: float = 1.0
    contrast: float = 1.0
    lift: float = 0.0
    tone: tuple[tuple[float, float], ...] = ()
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def ambient(self) -> NDArray[np.float64]:
        """(3,) irradiance of the sky on a horizontal surface."""
        return np.asarray(0.35 * self.sky_low + 0.65 * self.sky_high)

    @property
    def road_radiance(self) -> NDArray[np.float64]:
        """(3,) radiance of sunlit asphalt."""
        return np.asarray(self.road * (self.sun * max(self.sun_direction[2], 0.0) + self.ambient))

    @property
    def air(self) -> NDArray[np.float64]:
        """(3,) radiance of thick haze."""
        return np.asarray(0.7 * self.sky_low + 0.3 * self.ambient)

    @cached_property
    def curve(self) -> NDArray[np.float32]:
        """(3, 4 * `_CURVE_STEPS` + 2) linear red, green and blue, 0 to 4, to 0-255: a gamma with a soft shoulder."""
        value = np.arange(4 * _CURVE_STEPS + 2) / _CURVE_STEPS
        value = np.where(value > 0.6, 0.6 + 0.4 * (1 - np.exp(-(value - 0.6) / 0.4)), value) ** (1 / 2.2)
        middle = 0.45
        steep = middle + self.contrast * (value - middle)
        levels = 255 * (self.lift + (1 - self.lift) * steep.clip(0, 1))
        return np.asarray(np.outer(self.balance, self.toned(levels)).clip(0, 255), dtype=np.float32)

    def toned(self, levels: Any) -> NDArray[np.float64]:
        """Return grey levels, of any shape, after `tone`."""
        if not self.tone:
            return np.asarray(levels, dtype=np.float64)
        steps = np.array(self.tone)
        return np.asarray(np.interp(levels, steps[:, 0], steps[:, 1]))

    @cached_property
    def around(self) -> NDArray[np.float32]:
        """(192, 192, 3) environment map: radiance of sky, clouds, skyline and ground.

        Octahedral map: the square's middle is the zenith, its corners are the nadir, the diamond between them is the
        horizon; columns run along x, rows along y. See Engelhardt and Dachsbacher, Octahedron environment maps (2008).
        """
        return _surroundings(self)

    def through_air(self, radiance: Any, distance_m: Any) -> Any:
        """Return radiance (..., 3) after its way through the air over a distance (..., 1) in metres."""
        if not self.haze_per_m:
            return radiance
        transmitted = np.exp(np.float32(-self.haze_per_m) * distance_m)
        return radiance * transmitted + self.air.astype(np.float32) * (1 - transmitted)

    def grey_levels(self, radiance: Any) -> NDArray[np.float32]:
        """Return the camera's grey levels (..., 3) float32, 0 to 255, of radiance (..., 3), both RGB."""
        exposed = np.asarray(radiance, dtype=np.float32) * np.float32(self.exposure)
        if self.saturation != 1:
            grey = exposed @ _LUMA
            exposed = grey[..., None] + np.float32(self.saturation) * (exposed - grey[..., None])
        at = (np.clip(exposed, 0, 4) * _CURVE_STEPS).astype(np.int32)
        return np.asarray(self.curve[np.arange(3), at])

    def packed(self) -> NDArray[np.float64]:
        """Return (23,) float64, the light as `rasterizer.shade` takes it."""
        lit = 1.6 / self.exposure
        parts = (self.sun_direction, self.road_radiance, self.sun, self.horizon, self.sky_low, self.sky_high)
        return np.concatenate([*parts, [lit], self.air, [self.saturation]])


_RECIPES: dict[Weather, dict[str, Any]] = {
    Weather.DAY: {
        "height": (30, 60), "sun": (1.22, 1.19, 1.13), "low": (0.36, 0.385, 0.425),
        "high": (0.086, 0.10, 0.13), "horizon": (0.05, 0.06, 0.045), "road": (0.15, 0.148, 0.143),
        "exposure": 1.2, "noise": 1.5, "shutter": 1 / 800,
    },
    Weather.OVERCAST: {
        "height": (40, 70), "sun": (0.03, 0.03, 0.03), "low": (0.40, 0.41, 0.43),
        "high": (0.72, 0.75, 0.80), "horizon": (0.09, 0.095, 0.085), "road": (0.15, 0.15, 0.148),
        "exposure": 1.55, "noise": 1.7, "shutter": 1 / 400,
    },
    Weather.DUSK: {
        "height": (4, 9), "sun": (0.07, 0.035, 0.015), "low": (0.16, 0.12, 0.11),
        "high": (0.055, 0.065, 0.10), "horizon": (0.012, 0.012, 0.013), "road": (0.14, 0.138, 0.14),
        "exposure": 3.6, "noise": 3.4, "shutter": 1 / 120,
    },
    Weather.RAIN: {
        "height": (40, 70), "sun": (0.0, 0.0, 0.0), "low": (0.27, 0.28, 0.30),
        "high": (0.43, 0.455, 0.50), "horizon": (0.06, 0.065, 0.06), "road": (0.055, 0.056, 0.058),
        "exposure": 2.0, "noise": 2.3, "shutter": 1 / 250,
    },
}  # fmt: skip


def make_light(weather: Weather, rng: np.random.Generator) -> Light:
    """Sample the light of one weather: the sun's direction, brightness and tint vary."""
    recipe = _RECIPES[weather]
    height = np.radians(rng.uniform(*recipe["height"]))
    around = rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(height) * np.cos(around), np.cos(height) * np.sin(around), np.sin(height)])
    tint = rng.normal(1, 0.02, 3)
    level = rng.uniform(0.9, 1.1)
    return Light(
        weather,
        sun,
        np.array(recipe["sun"]) * level,
        np.array(recipe["low"]) * tint * level,
        np.array(recipe["high"]) * tint * level,
        np.array(recipe["horizon"]) * level,
        np.array(recipe["road"]) * rng.uniform(0.85, 1.15),
        recipe["exposure"],
        recipe["noise"],
        recipe["shutter"],
        weather in (Weather.DUSK, Weather.RAIN),
    )


def varied_light(light: Light, rng: np.random.Generator) -> Light:
    """Sample the same weather with another road surface, haze and camera.

    Asphalt is new or old, or pale concrete; air is clear or hazy; tone curves, saturation and tint differ.
    """
    tone = float(np.exp(rng.normal(0, 0.25))) if rng.random() < 0.75 else rng.uniform(1.5, 2.4)
    road = light.road * tone * rng.normal(1, 0.02, 3)
    # Automatic exposure compensates for half of the difference.
    before = float(light.road_radiance.mean())
    after = float(replace(light, road=road).road_radiance.mean())
    hazy = rng.random() < 0.22
    cast = rng.normal(1, 0.035 if rng.random() < 0.3 else 0.012, 3)
    flat = not hazy and rng.random() < 0.2
    # Less skylight, and so deeper shadows, in clear air.
    clear = rng.uniform(0.5, 1.05) if light.sun.max() > 0.3 and not hazy else 1.0
    return replace(
        light,
        road=road,
        sun=light.sun * cast * rng.uniform(0.8, 1.25),
        sky_low=light.sky_low * cast * clear,
        sky_high=light.sky_high * cast * clear,
        horizon=light.horizon * cast,
        exposure=light.exposure * (before / after) ** 0.5 * rng.uniform(0.85, 1.25),
        noise=light.noise * rng.uniform(0.5, 1.8),
        haze_per_m=rng.uniform(0.002, 0.010) if hazy else rng.uniform(0, 0.0015),
        saturation=rng.uniform(0.0, 0.6) if rng.random() < 0.17 else rng.uniform(0.85, 1.6),
        contrast=rng.uniform(0.6, 0.85) if flat else rng.uniform(1.0, 1.4),
        lift=rng.uniform(0.02, 0.15) if flat else 0.0,
    )


def _waves(azimuth: NDArray[Any], rng: np.random.Generator, octaves: int) -> NDArray[np.float64]:
    """Return periodic noise around the horizon, about -1 to 1."""
    total = np.zeros_like(azimuth)
    for k in range(octaves):
        total += np.sin((2 * k + 2) * azimuth + rng.uniform(0, 2 * np.pi)) / (1 + 0.5 * k)
    return total / 2


def _surroundings(light: Light, side: int = 192) -> NDArray[np.float32]:
    """Return the environment map of `Light.around`."""
    rng = np.random.default_rng(int(1e6 * (1 + light.sun_direction[0])))
    grid = (np.arange(side) + 0.5) / side * 2 - 1
    u, v = np.meshgrid(grid, grid)
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.clip(-z, 0, None)
    x, y = u - np.sign(u) * fold, v - np.sign(v) * fold
    norm = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    azimuth = np.arctan2(y, x)
    climb = np.sqrt(np.clip(z, 0, 1))[..., None]
    out = light.sky_low + (light.sky_high - light.sky_low) * climb
    # Clouds: wide bright patches under a clear sky, hardly darker ones under a grey one. Their reflections on curved
    # panels are a few pixels large, so that finer ones would look like dirt.
    with np.errstate(divide="ignore"):
        flat_x, flat_y = x / np.maximum(z, 0.08), y / np.maximum(z, 0.08)
    puffs = np.zeros_like(z)
    for scale in (0.7, 1.5):
        a, b, c = rng.uniform(0, 2 * np.pi, 3)
        puffs += np.sin(scale * flat_x + a + np.sin(scale * flat_y + b)) * np.cos(scale * flat_y + c) / scale**0.5
    cloud = (1 / (1 + np.exp(-2.5 * (puffs - rng.uniform(0.0, 1.2)))))[..., None]
    white = 0.45 * (light.sun + light.ambient) if light.sun.max() > 0.3 else 0.62 * light.sky_high
    out = out + (white - out) * cloud * 0.5
    if light.sun.max() > 0.3:  # air is bright around the sun
        off = 1 - (x * light.sun_direction[0] + y * light.sun_direction[1] + z * light.sun_direction[2])[..., None]
        out = out + light.sun * (0.55 * np.exp(-off / 0.02) + 0.07 * np.exp(-off / 0.15))
    # Woods and houses, lower where the road runs.
    skyline = (0.14 + 0.12 * _waves(azimuth, rng, 7)) * (0.25 + 0.75 * np.abs(np.sin(azimuth)))
    dark = light.horizon * (1 + 0.5 * _waves(azimuth * 3, rng, 5))[..., None]
    out = np.where((z < skyline)[..., None], dark, out)
    verge = 0.5 * light.road_radiance + 0.5 * light.horizon
    beside = np.clip(np.abs(np.sin(azimuth)) * 3 * (1 + z) - 0.6, 0, 1)[..., None]
    ground = light.road_radiance * (1 - beside) + verge * beside
    depth = np.clip(-z * 5, 0, 1)[..., None]
    out = np.where((z < 0)[..., None], light.horizon + (ground - light.horizon) * depth, out)
    # Blurred, since paint is not flat; the map keeps neighbours together except at its border.
    return np.ascontiguousarray(cv2.GaussianBlur(out.astype(np.float32), (0, 0), 1.2))
