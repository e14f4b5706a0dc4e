"""Hypotheses about vehicles, and the state of their fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.vehicle_fit.measurements import MeasuredSilhouettes
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import Body

__all__ = ["BodyHypotheses", "ModelFit", "initial_fit"]


@dataclass(frozen=True, eq=False)
class BodyHypotheses:
    """H types of vehicle and directions of travel.

    Args:
        points: (H, V, 3) metres, each body driving away from the camera and towards it, filled up to one number of
            points.
        log_prior: (H,).
    """

    points: Array
    log_prior: Array

    @classmethod
    def from_bodies(cls, bodies: Sequence[Body]) -> BodyHypotheses:
        """Return two hypotheses per body, one for each direction of travel."""
        count = max(len(body.points) for body in bodies)
        filled = [np.concatenate([b.points, np.repeat(b.points[:1], count - len(b.points), axis=0)]) for b in bodies]
        turned = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]])
        points = np.concatenate([p * turned[:, None] for p in filled])
        return cls(points, np.log([body.share / 2 for body in bodies for _ in range(2)]))


@dataclass(frozen=True, eq=False)
class ModelFit:
    """P pairs of a vehicle and a hypothesis, and R observations of pairs, in the pairs' order.

    Args:
        vehicle, hypothesis: (P,).
        shape: (P, 6) log of road units per metre and of the stretch along each axis; shadow, swelling.
        silhouette, pair: (R,).
        place: (R, 2) on the road, road units.
        included: (R,) 1 or 0, whether the observation counts.
    """

    vehicle: NDArray[np.int64]
    hypothesis: NDArray[np.int64]
    shape: Array
    silhouette: NDArray[np.int64]
    pair: NDArray[np.int64]
    place: Array
    included: Array

    def select_pairs(self, pairs: NDArray[np.bool_]) -> ModelFit:
        """Return some of the pairs (P,)."""
        rows = pairs[self.pair]
        number = np.cumsum(pairs) - 1
        return ModelFit(
            self.vehicle[pairs],
            self.hypothesis[pairs],
            self.shape[pairs],
            self.silhouette[rows],
            number[self.pair[rows]],
            self.place[rows],
            self.included[rows],
        )

    def sum_over_pairs(self, values: Array) -> Array:
        """Return sums (P, ...) of values (R, ...) over each pair's observations."""
        starts = np.searchsorted(self.pair, np.arange(len(self.vehicle)))
        return np.asarray(np.add.reduceat(values, starts, axis=0))


def initial_fit(measured: MeasuredSilhouettes, hypotheses: BodyHypotheses, settings: VehicleFitSettings) -> ModelFit:
    """Return every pair of vehicle and hypothesis, with the size guessed from the silhouettes' widths."""
    vehicles, kinds = int(measured.vehicles.max()) + 1, len(hypotheses.log_prior)
    log_size = measured.guess_log_size(settings)
    # Observations in the order of the pairs, which are in the order of the vehicles.
    key = (measured.vehicles[:, None] * kinds + np.arange(kinds)).ravel()
    order = np.argsort(key, kind="stable")
    shape = np.tile(settings.shape_mean, (vehicles * kinds, 1))
    shape[:, 0] = log_size
    silhouette = np.repeat(np.arange(len(measured.sizes)), kinds)[order]
    place = measured.feet[silhouette] + [settings.typical_half_length_m * np.exp(log_size), 0.0]
    return ModelFit(
        np.repeat(np.arange(vehicles), kinds),
        np.tile(np.arange(kinds), vehicles),
        shape,
        silhouette,
        key[order],
        place,
        np.ones(len(silhouette)),
    )
