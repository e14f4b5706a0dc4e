"""Noise on the panels of a video's vehicles: codecs leave less noise on moving parts than on still ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from labelgen.synth.fitting.lighting import VehiclePart
from labelgen.synth.sensor.noise import NoiseModel

__all__ = ["PANELS", "PanelThresholds", "fit_to_panels", "panel_noise"]


@dataclass(frozen=True)
class PanelThresholds:
    """Thresholds for measuring noise on vehicles.

    Args:
        min_pixels: pixels of one brightness that a vehicle must have.
        min_vehicles: vehicles that must have that brightness.
        even_percentile: percentile of a vehicle's local deviation that shows noise rather than shape.
        even_vehicles_percentile: percentile over the vehicles, likewise.
        white_noise_share: share of white noise's standard deviation that these percentiles find on even pictures.
        level_factor: how much noisier one brightness may be than the next.
    """

    min_pixels: int = 30
    min_vehicles: int = 4
    even_percentile: float = 10
    even_vehicles_percentile: float = 20
    white_noise_share: float = 0.55
    level_factor: float = 1.35


PANELS = PanelThresholds()


def panel_noise(parts: Sequence[VehiclePart], levels: int, thresholds: PanelThresholds = PANELS) -> list[float]:
    """Return the standard deviation of details finer than 1.5 px where vehicles are most even.

    Args:
        parts: windows that show vehicles, and their masks.
        levels: number of brightnesses, spread evenly from 0 to 255.
        thresholds: of this stage.

    Returns:
        Grey levels for each brightness; nan where too few vehicles are that bright.
    """
    deviations: list[list[float]] = [[] for _ in range(levels)]
    step = 255 / (levels - 1)
    for image, mask in parts:
        grey: Any = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        off = grey - cv2.GaussianBlur(grey, (3, 3), 0.85)
        spread = np.sqrt(cv2.blur(off * off, (5, 5)))
        at = np.round(cv2.blur(grey, (5, 5)) / step)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        for k in range(levels):
            here = spread[inner & (at == k)]
            if len(here) >= thresholds.min_pixels:
                deviations[k].append(float(np.percentile(here, thresholds.even_percentile)))
    percentile, fewest = thresholds.even_vehicles_percentile, thresholds.min_vehicles
    return [float(np.percentile(d, percentile)) if len(d) >= fewest else np.nan for d in deviations]


def fit_to_panels(
    noise_model: NoiseModel, parts: Sequence[VehiclePart], thresholds: PanelThresholds = PANELS
) -> NoiseModel:
    """Return the noise model with the share of the noise that even panels of a video's vehicles show.

    Args:
        noise_model: of the video's road.
        parts: windows that show vehicles, and their masks.
        thresholds: of this stage.
    """
    noise = np.array(panel_noise(parts, len(noise_model.grey), thresholds))
    known = np.flatnonzero(np.isfinite(noise))
    if not len(known):
        return noise_model
    at_most = np.interp(np.arange(len(noise)), known, noise[known]) / thresholds.white_noise_share
    # Shape can only add to the measured noise, and similar brightnesses have similar noise. So the least noisy ones
    # limit their neighbours.
    apart = np.abs(np.subtract.outer(np.arange(len(noise)), np.arange(len(noise))))
    at_most = (at_most[None] * thresholds.level_factor**apart).min(axis=1)
    shares = np.clip(at_most / np.maximum(noise_model.grey, 0.1), 0, 1)
    return replace(noise_model, on_vehicles=tuple(shares.tolist()))
