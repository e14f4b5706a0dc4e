"""Scale from the shapes of common vehicles: bodies are fitted to the silhouettes, and the most probable scale is taken.

For each silhouette, type of vehicle and direction of travel, `vehicle_fit` gives a scale, its variance, and the cost of
the fit. One silhouette says little, for a small car nearby and a large one far away look much alike. All share one
scale, so their log-evidence is summed: each silhouette is one of the types with the probability of that type in
traffic, or none of them (a merged pair, a shadow, a lorry).

Source: Sochor et al., CVIU 2017 (models of common types, aligned with detections; there the type comes from a
classifier, and bounding boxes are compared).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.road_units import unit_camera
from labelgen.calibration.scale.estimate import USE_DISTANCE, ScaleEstimate, time_blocks
from labelgen.calibration.vehicle_fit.measurements import MeasuredSilhouettes, measure_silhouettes
from labelgen.calibration.vehicle_fit.model_fit import BodyHypotheses, ModelFit, initial_fit
from labelgen.calibration.vehicle_fit.optimize import optimize_fit, shape_prior_costs, size_variance
from labelgen.calibration.vehicle_fit.residuals import fit_residuals
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import common_bodies

__all__ = ["ModelScaleSettings", "scale_from_models"]


@dataclass(frozen=True)
class ModelScaleSettings:
    """How the scale is estimated from vehicle bodies."""

    min_size_share: float = 0.025
    """Smallest silhouette: square root of its area as a share of the frame's width; smaller ones say too little."""
    max_silhouettes: int = 300
    """The largest silhouettes are used, up to so many; more cost time."""
    min_silhouettes: int = 8
    """Fewest silhouettes, and fewest of them that a body explains."""
    steps: int = 8
    """Steps of the fit."""
    steps_before_choice: int = 4
    """Steps after which improbable hypotheses are dropped."""
    max_score_gap: float = 10.0
    """A hypothesis whose log-probability is this much below the best one's of its silhouette is dropped; smaller values
    save time and may drop the right one."""
    unknown_probability: float = 1e-3
    """Likelihood of a silhouette that is no known vehicle; larger values ignore more of the odd ones."""
    min_log_size: float = -1.6
    """Smallest size tried, as the logarithm of its ratio to the first guess. The guess is rather too large: the
    silhouette of a vehicle seen from the side is as wide as it is long."""
    max_log_size: float = 0.8
    """Largest size tried, likewise."""
    size_steps: int = 1201
    """Sizes tried."""
    block_s: float = 5.0
    """Length of the stretches of video that are resampled, seconds; a vehicle should lie in about one."""
    resamples: int = 100
    """Resamples for the spread; more cost time."""
    fit: VehicleFitSettings = field(default_factory=VehicleFitSettings)
    """Of bodies to silhouettes."""


@dataclass(frozen=True, eq=False)
class _FittedSizes:
    """Sizes of P pairs of a silhouette and a hypothesis.

    Args:
        silhouette: (P,) number of the silhouette.
        log_size: (P,) logarithm of road units per metre.
        variance: (P,) of that.
        score: (P,) log of how well the body fits.
    """

    silhouette: NDArray[np.int64]
    log_size: Array
    variance: Array
    score: Array


def scale_from_models(
    camera: Camera,
    silhouettes: Sequence[VehicleSilhouette],
    *,
    seed: int = 0,
    settings: ModelScaleSettings | None = None,
) -> ScaleEstimate:
    """Estimate the scale by fitting bodies of common vehicles.

    Args:
        camera: with the frame's size; its scale is not used.
        silhouettes: of vehicles that drive along VP1, as many as there are.
        seed: of the resampling.
        settings: thresholds.

    Returns:
        the scale; `count` is the number of silhouettes that a body explains, `details` holds how many there were.

    Raises:
        CalibrationError: too few silhouettes, or too few that look like vehicles.
    """
    settings = settings or ModelScaleSettings()
    unit = unit_camera(camera)
    measured = _measure_largest(unit, silhouettes, settings)
    count, least = len(measured.sizes), settings.min_silhouettes
    if count < least:
        raise CalibrationError(
            f"auto-models: {count} silhouettes of vehicles are large and whole enough to fit models to, at least "
            f"{least} are needed; {USE_DISTANCE}",
            parameter="scale",
        )
    hypotheses = BodyHypotheses.from_bodies(common_bodies())
    fitted = _fit_sizes(unit, measured, hypotheses, settings)
    guess = measured.guess_log_size(settings.fit)
    grid = np.linspace(settings.min_log_size, settings.max_log_size, settings.size_steps)
    evidence = _log_evidence(fitted, guess + grid, settings.unknown_probability)
    best = int(evidence.sum(axis=0).argmax())
    explained = int(np.count_nonzero(evidence[:, best] > np.log(2 * settings.unknown_probability)))
    if explained < least or best in (0, len(grid) - 1):
        raise CalibrationError(
            f"auto-models: {explained} of {count} silhouettes look like vehicles along the road, at least {least} are "
            f"needed; {USE_DISTANCE}",
            parameter="scale",
        )
    log_size = guess + _parabola_peak(evidence.sum(axis=0), best, grid)
    return ScaleEstimate(
        float(np.exp(-log_size)),
        explained,
        _resampled_spread(evidence, measured.times_s, grid, seed, settings),
        "auto-models",
        {"silhouettes": count, "explained": explained},
    )


def _measure_largest(
    unit: Camera, silhouettes: Sequence[VehicleSilhouette], settings: ModelScaleSettings
) -> MeasuredSilhouettes:
    """Measure the largest silhouettes, each as a vehicle of its own."""
    assert unit.image_wh is not None
    least = settings.min_size_share * unit.image_wh[0]
    sizes = np.array([np.sqrt(cv2.contourArea(s.polygon_px.astype(np.float32))) for s in silhouettes])
    large = [silhouettes[i] for i in np.argsort(-sizes, kind="stable").tolist() if sizes[i] >= least]
    measured, _ = measure_silhouettes(unit, large, np.arange(len(large)), settings.fit)
    return measured.select(np.arange(len(measured.sizes)) < settings.max_silhouettes)


def _fit_sizes(
    unit: Camera, measured: MeasuredSilhouettes, hypotheses: BodyHypotheses, settings: ModelScaleSettings
) -> _FittedSizes:
    """Fit all hypotheses to all silhouettes, and the better ones to the end."""
    fit = initial_fit(measured, hypotheses, settings.fit)
    fit = optimize_fit(unit, measured, hypotheses, fit, settings.steps_before_choice, settings.fit)
    score = _scores(unit, measured, hypotheses, fit, settings.fit)[0]
    best = np.maximum.reduceat(score, np.searchsorted(fit.vehicle, np.arange(len(measured.sizes))))
    fit = fit.select_pairs(score > best[fit.vehicle] - settings.max_score_gap)
    steps = settings.steps - settings.steps_before_choice
    fit = optimize_fit(unit, measured, hypotheses, fit, steps, settings.fit)
    score, variance = _scores(unit, measured, hypotheses, fit, settings.fit)
    return _FittedSizes(fit.vehicle, fit.shape[:, 0], variance, score)


def _scores(
    unit: Camera,
    measured: MeasuredSilhouettes,
    hypotheses: BodyHypotheses,
    fit: ModelFit,
    settings: VehicleFitSettings,
) -> tuple[Array, Array]:
    """Return the log-probability (P,) of each pair, very low for a fit that failed; and its log size's variance."""
    residuals = fit_residuals(unit, measured, hypotheses, fit, settings)
    variance = size_variance(fit, residuals, settings)
    score = hypotheses.log_prior[fit.hypothesis] - fit.sum_over_pairs(residuals.costs)
    score = score - shape_prior_costs(fit, settings)
    good = np.isfinite(score) & np.isfinite(variance) & (variance > 0)
    return np.where(good, score, -1e6), np.where(good, variance, 1.0)


def _log_evidence(fitted: _FittedSizes, log_sizes: Array, unknown_probability: float) -> Array:
    """Return the log-evidence (N, S) of each of S sizes from each of N silhouettes."""
    miss = (log_sizes - fitted.log_size[:, None]) ** 2 / (2 * fitted.variance[:, None])
    starts = np.flatnonzero(np.diff(fitted.silhouette, prepend=-1))
    logs = np.logaddexp.reduceat(fitted.score[:, None] - miss, starts, axis=0)
    return np.asarray(np.logaddexp(logs, np.log(unknown_probability)))


def _parabola_peak(total: Array, best: int, grid: Array) -> float:
    """Return the grid's value at the vertex of a parabola through the best value and its neighbours."""
    before, at, after = total[best - 1 : best + 2]
    second = before - 2 * at + after
    shift = 0.5 * (before - after) / second if second < 0 else 0.0
    return float(grid[best] + np.clip(shift, -0.5, 0.5) * (grid[1] - grid[0]))


def _resampled_spread(evidence: Array, times_s: Array, grid: Array, seed: int, settings: ModelScaleSettings) -> float:
    """Return the standard deviation of the best size's logarithm over resampled stretches of the video."""
    rng = np.random.default_rng(seed)
    sums = np.array([evidence[block].sum(axis=0) for block in time_blocks(times_s, settings.block_s)])
    draws: NDArray[np.int64] = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=settings.resamples)
    return float(grid[(draws @ sums).argmax(axis=1)].std())
