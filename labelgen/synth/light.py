"""Weather: where the sun stands, how bright sky and road are, and what the camera makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError

__all__ = ["Light", "Weather", "make_light"]


class Weather(StrEnum):
    """Kinds of light."""

    DAY = "day"
    OVERCAST = "overcast"
    DUSK = "dusk"
    RAIN = "rain"

    @classmethod
    def parse(cls, text: str) -> Weather:
        """Weather from its name; LabelgenError names the known ones."""
        for weather in cls:
            if weather.value == text.strip().lower():
                return weather
        raise LabelgenError(f"--weather {text}: unknown; use one of {', '.join(w.value for w in cls)}")


@dataclass(frozen=True, eq=False)
class Light:
    """The light of a recording, in linear RGB; white paint in the open is about 1 at exposure 1.

    Args:
        weather: what it is.
        sun_direction: (3,) unit vector towards the sun, road frame.
        sun: (3,) irradiance on a surface that faces the sun; zero when hidden.
        sky_low, sky_high: (3,) radiance near the horizon and overhead.
        horizon: (3,) radiance of trees and houses.
        road: (3,) albedo of asphalt.
        exposure: factor before the camera's curve.
        noise: standard deviation of the sensor's noise in grey levels.
        shutter_s: exposure time.
        lamps: whether vehicles have their lamps on.
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

    @property
    def ambient(self) -> NDArray[np.float64]:
        """(3,) irradiance of the whole sky on a surface that faces up."""
        return np.asarray(0.35 * self.sky_low + 0.65 * self.sky_high)

    @property
    def road_radiance(self) -> NDArray[np.float64]:
        """(3,) radiance of sunlit asphalt."""
        return np.asarray(self.road * (self.sun * max(self.sun_direction[2], 0.0) + self.ambient))

    def packed(self) -> NDArray[np.float64]:
        """(19,) as `raster.shade` takes it."""
        lit = 1.6 / self.exposure
        parts = (self.sun_direction, self.road_radiance, self.sun, self.horizon, self.sky_low, self.sky_high)
        return np.append(np.concatenate(parts), lit)


_RECIPES: dict[Weather, dict[str, Any]] = {
    Weather.DAY: {
        "height": (30, 60), "sun": (1.24, 1.19, 1.10), "low": (0.34, 0.38, 0.44),
        "high": (0.075, 0.10, 0.155), "horizon": (0.05, 0.06, 0.045), "road": (0.15, 0.148, 0.143),
        "exposure": 1.2, "noise": 1.5, "shutter": 1 / 800,
    },
    Weather.OVERCAST: {
        "height": (40, 70), "sun": (0.03, 0.03, 0.03), "low": (0.62, 0.64, 0.67),
        "high": (0.60, 0.63, 0.67), "horizon": (0.09, 0.095, 0.085), "road": (0.15, 0.15, 0.148),
        "exposure": 1.55, "noise": 1.7, "shutter": 1 / 400,
    },
    Weather.DUSK: {
        "height": (4, 9), "sun": (0.07, 0.035, 0.015), "low": (0.16, 0.12, 0.11),
        "high": (0.055, 0.065, 0.10), "horizon": (0.012, 0.012, 0.013), "road": (0.14, 0.138, 0.14),
        "exposure": 3.6, "noise": 3.4, "shutter": 1 / 120,
    },
    Weather.RAIN: {
        "height": (40, 70), "sun": (0.0, 0.0, 0.0), "low": (0.40, 0.42, 0.45),
        "high": (0.36, 0.38, 0.42), "horizon": (0.06, 0.065, 0.06), "road": (0.055, 0.056, 0.058),
        "exposure": 2.0, "noise": 2.3, "shutter": 1 / 250,
    },
}  # fmt: skip


def make_light(weather: Weather, rng: np.random.Generator) -> Light:
    """Light of one kind; the sun's place and the balance of colours vary."""
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
