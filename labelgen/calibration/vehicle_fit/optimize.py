"""Gauss-Newton on the fit, with the positions of the silhouettes eliminated from the normal equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labelgen.calibration.vehicle_fit.measurements import MeasuredSilhouettes
from labelgen.calibration.vehicle_fit.model_fit import BodyHypotheses, ModelFit
from labelgen.calibration.vehicle_fit.residuals import FitResiduals, fit_residuals
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["add_shape_priors", "eliminate_positions", "optimize_fit", "shape_prior_costs", "size_variance"]

_TINY = 1e-9


def optimize_fit(
    unit: Camera,
    measured: MeasuredSilhouettes,
    hypotheses: BodyHypotheses,
    fit: ModelFit,
    steps: int,
    settings: VehicleFitSettings,
) -> ModelFit:
    """Return the fit after some Gauss-Newton steps, all pairs at once.

    Args:
        unit: camera with the frame's size, scale 1.
        measured: the silhouettes.
        hypotheses: the bodies.
        fit: the start.
        steps: how many.
        settings: of the fit.
    """
    for _ in range(steps):
        residuals = fit_residuals(unit, measured, hypotheses, fit, settings)
        normal, pull, back = eliminate_positions(fit, residuals, residuals.slopes[..., 2:])
        normal, pull = add_shape_priors(fit, normal, pull, settings)
        change = np.linalg.solve(normal, pull[..., None])[..., 0]
        change = np.clip(change, -settings.max_step, settings.max_step)
        moved = back[..., -1] - np.einsum("rij,rj->ri", back[..., :-1], change[fit.pair])
        longest = settings.max_move_m * np.exp(fit.shape[fit.pair, :1])
        fit = replace(fit, shape=fit.shape + change, place=fit.place + np.clip(moved, -longest, longest))
    return fit


def eliminate_positions(fit: ModelFit, residuals: FitResiduals, slopes: Array) -> tuple[Array, Array, Array]:
    """Return normal equations of the parameters that a pair's observations share: the Schur complement of positions.

    Args:
        fit: of P pairs and R observations.
        residuals: of the fit.
        slopes: (R, M, K) derivatives of the prediction by K shared parameters, in standard deviations.

    Returns:
        normal matrices (P, K, K) and right sides (P, K), without priors; and (R, 2, K + 1) from which the change of the
        positions follows: the last column minus the others times the change of the parameters.
    """
    own = residuals.slopes[..., :2]
    weighted = own * residuals.weights[..., None]
    a, b, c = weighted[..., 0], weighted[..., 1], np.swapaxes(weighted, -1, -2)
    xx, yy = ((w * own[..., k]).sum(axis=-1) + _TINY for k, w in enumerate((a, b)))
    xy = (a * own[..., 1]).sum(axis=-1)
    inverse = np.stack([np.stack([yy, -xy], -1), np.stack([-xy, xx], -1)], -2) / (xx * yy - xy**2)[:, None, None]
    right = c @ np.concatenate([slopes, residuals.miss[..., None]], axis=-1)
    back = inverse @ right
    shared = np.swapaxes(slopes * residuals.weights[..., None], -1, -2)
    full = shared @ np.concatenate([slopes, residuals.miss[..., None]], axis=-1)
    full -= np.swapaxes(right[..., :-1], -1, -2) @ back
    total = fit.sum_over_pairs(full)
    return total[..., :-1], total[..., -1], back


def add_shape_priors(fit: ModelFit, normal: Array, pull: Array, settings: VehicleFitSettings) -> tuple[Array, Array]:
    """Return normal equations (P, K, K), (P, K), whose first 6 parameters are the shape, with the shape's prior."""
    precision = settings.shape_precision
    count = len(precision)
    normal, pull = normal.copy(), pull.copy()
    normal[:, :count, :count] += np.diag(precision + np.array([settings.size_precision, 0, 0, 0, 0, 0]))
    pull[:, :count] -= precision * (fit.shape - settings.shape_mean)
    return normal, pull


def shape_prior_costs(fit: ModelFit, settings: VehicleFitSettings) -> Array:
    """Return what proportions, shadow and swelling of each pair (P,) cost: half the sum of squares."""
    return np.asarray((settings.shape_precision * (fit.shape - settings.shape_mean) ** 2).sum(axis=-1) / 2)


def size_variance(fit: ModelFit, residuals: FitResiduals, settings: VehicleFitSettings) -> Array:
    """Return the variance (P,) of each pair's log size, the other shape parameters and positions eliminated."""
    reduced = eliminate_positions(fit, residuals, residuals.slopes[..., 2:])[:2]
    normal, _ = add_shape_priors(fit, *reduced, settings)
    return np.asarray(np.linalg.inv(normal)[:, 0, 0])
