"""How even the panels of a video's vehicles are: recorders leave less noise on what moves than on what stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from labelgen.synth.fitting.lighting import Part
from labelgen.synth.sensor.noise import NoiseModel

__all__ = ["fit_to_panels", "panel_noise"]

_FEWEST_PX, _FEWEST = 30, 4
_EVEN_PX, _EVENEST_VEHICLES = 10, 20
"""Percentiles: a vehicle's evenest places, and of those the evenest vehicles', show noise rather than shape."""
_SEEN = 0.55
"""What of white noise's standard deviation `panel_noise` finds at those places, as measured on even pictures."""

_PER_LEVEL = 1.35
"""How much noisier one brightness may be than the next."""


def panel_noise(parts: Sequence[Part], levels: int) -> list[float]:
    """Standard deviation of what is finer than a pixel and a half where vehicles are evenest.

    Args:
        parts: vehicles.
        levels: at how many brightnesses, spread evenly from 0 to 255.

    Returns:
        grey levels; nan where too few vehicles are that bright.
    """
    found: list[list[float]] = [[] for _ in range(levels)]
    step = 255 / (levels - 1)
    for image, mask in parts:
        grey: Any = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        off = grey - cv2.GaussianBlur(grey, (3, 3), 0.85)
        spread = np.sqrt(cv2.blur(off * off, (5, 5)))
        at = np.round(cv2.blur(grey, (5, 5)) / step)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        for k in range(levels):
            here = spread[inner & (at == k)]
            if len(here) >= _FEWEST_PX:
                found[k].append(float(np.percentile(here, _EVEN_PX)))
    return [float(np.percentile(f, _EVENEST_VEHICLES)) if len(f) >= _FEWEST else np.nan for f in found]


def fit_to_panels(noise_model: NoiseModel, parts: Sequence[Part]) -> NoiseModel:
    """The noise with the share of it that even panels of a video's vehicles show.

    Args:
        noise_model: of the video's road.
        parts: its vehicles.
    """
    seen = np.array(panel_noise(parts, len(noise_model.grey)))
    known = np.flatnonzero(np.isfinite(seen))
    if not len(known):
        return noise_model
    most = np.interp(np.arange(len(seen)), known, seen[known]) / _SEEN
    # Shape adds to what is seen and never takes away, and brightnesses that are near each other have much the same
    # noise: the calmest ones tell what there is at most in those beside them.
    apart = np.abs(np.subtract.outer(np.arange(len(seen)), np.arange(len(seen))))
    most = (most[None] * _PER_LEVEL**apart).min(axis=1)
    shares = np.clip(most / np.maximum(noise_model.grey, 0.1), 0, 1)
    return replace(noise_model, on_vehicles=tuple(shares.tolist()))
