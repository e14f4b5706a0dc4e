"""The steady path of a vehicle, which the places of its sightings are drawn towards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labelgen.geometry.homography import Array
from labelgen.labeling.fitted.hypotheses import BodyFit
from labelgen.labeling.fitted.settings import BodyFitSettings

__all__ = ["back_to_path", "expected_path"]

_FEWEST = 3
"""Sightings from which a path is drawn through them."""
_ROUNDS = 3
_FREE = 1e-6


def back_to_path(fit: BodyFit, times_s: Array, settings: BodyFitSettings) -> BodyFit:
    """Return the fit with sightings that strayed from the vehicle's path put back on it.

    A mask that lacks a side fits a body that stands too far to the other side as well.
    """
    expected, precision = expected_path(fit, times_s, settings)
    strayed = (precision[:, :2] * (expected[:, :2] - fit.place) ** 2).max(axis=1) > settings.path_robust**2
    return replace(fit, place=np.where(np.asarray(strayed)[:, None], expected[:, :2], fit.place))


def expected_path(fit: BodyFit, times_s: Array, settings: BodyFitSettings) -> tuple[Array, Array]:
    """Return where each sighting is expected, and how surely.

    A vehicle goes on at its speed in its direction: a straight line in time through its places, found robustly, as
    single places may be wrong by metres where a mask lacks a part.

    Args:
        fit: P hypotheses with R sightings.
        times_s: seconds, of all outlines.
        settings: of the fit.

    Returns:
        place and heading (R, 3) that are expected, metres and radians, and their precisions (R, 3).
    """
    rows = fit.hypothesis
    expected = np.concatenate([fit.place, np.zeros((len(rows), 1))], axis=1)
    precision = np.tile([_FREE, _FREE, 1 / settings.heading_sd**2], (len(rows), 1))
    count = fit.sum_rows(np.ones(len(rows)))
    if (count < _FEWEST).all():
        return expected, precision
    time = times_s[fit.outline] - (fit.sum_rows(times_s[fit.outline]) / count)[rows]
    # A straight line holds for a short time: vehicles brake, and change lanes.
    half = fit.max_rows(np.abs(time))[rows]
    sd = np.asarray(settings.path_sd_m) + half[:, None] ** 2 / 2 * np.asarray(settings.path_acceleration_ms2)
    weight = np.ones(len(rows))
    for _ in range(_ROUNDS):
        total = fit.sum_rows(weight)
        middle = fit.sum_rows(weight * time) / total
        places = fit.sum_rows(weight[:, None] * fit.place) / total[:, None]
        off = time - middle[rows]
        spread = fit.sum_rows(weight * off**2)
        rate = fit.sum_rows((weight * off)[:, None] * (fit.place - places[rows])) / np.maximum(spread, 1e-9)[:, None]
        line = places[rows] + rate[rows] * off[:, None]
        strayed = (((fit.place - line) / sd) ** 2).sum(axis=1)
        weight = 1 / (1 + strayed / settings.path_robust**2)
    enough = count[rows] >= _FEWEST
    expected[enough, :2] = line[enough]
    precision[enough, :2] = 1 / sd[enough] ** 2
    return expected, precision
