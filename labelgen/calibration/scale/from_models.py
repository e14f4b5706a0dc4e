"""Scale from the forms of common vehicles: models are laid over the silhouettes, and the scale that suits most wins.

For each silhouette, type of vehicle and direction of travel, `model_fit` gives a scale, its variance, and how badly the
model fits. One silhouette says little, for a small car near by and a large one far away look much alike; but all share
one scale, so the evidence of all is added up, each silhouette being one of the types with the probability of that type
in traffic, or nothing that is known at all: a merged pair, a shadow, a lorry.

Source: Sochor et al., CVIU 2017 (models of common types, aligned with detections; there the type comes from a
classifier, and bounding boxes are compared).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.silhouettes import Blob
from labelgen.calibration.scale.estimate import ScaleEstimate, time_blocks, unit_camera
from labelgen.calibration.vehicle_fit import (
    Fit,
    Hypotheses,
    Silhouettes,
    eliminate,
    first_fit,
    improve,
    measure,
    prior_costs,
    residuals,
    with_priors,
)
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import Body, common_bodies

__all__ = ["scale_from_models"]

_STEPS, _STEPS_BEFORE_CHOICE = 8, 4
# A hypothesis that costs this much more than the best one of the same silhouette tells nothing.
_HOPELESS = 10.0
# Silhouettes smaller than this share of the frame's width say too little, and more than so many of them no more.
_SMALLEST, _MOST = 0.025, 300
_UNKNOWN = 1e-3
# Sizes tried, as the logarithm of their ratio to the first guess, which is too large rather than too small: the
# silhouette of a vehicle seen from the side is as wide as it is long.
_GRID = np.linspace(-1.6, 0.8, 1201)
_FEWEST = 8
_BLOCK_S = 5.0
_RESAMPLES = 100


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Per pair (P,): its silhouette; log of units per metre, the variance of that, log of how well the model fits."""

    silhouette: NDArray[np.int64]
    sigma: Array
    variance: Array
    score: Array


def scale_from_models(
    camera: Camera, blobs: Sequence[Blob], *, bodies: Sequence[Body] | None = None, seed: int = 0
) -> ScaleEstimate:
    """Scale by fitting models of common vehicles.

    Args:
        camera: with the frame's size; its scale is not used.
        blobs: silhouettes of vehicles that drive along VP1, as many as there are.
        bodies: the types in traffic; `common_bodies` by default.
        seed: of the resampling.

    Returns:
        the scale; `count` is the number of silhouettes that a model explains, `details` holds how many there were.

    Raises:
        CalibrationError: too few silhouettes, or too few that look like vehicles.
    """
    unit = unit_camera(camera)
    seen = _measure(unit, blobs)
    if len(seen.sizes) < _FEWEST:
        raise CalibrationError(
            f"scale: {len(seen.sizes)} silhouettes of vehicles are large and whole enough to fit models to, at least "
            f"{_FEWEST} are needed; use more of the video, or a known distance (--scale distance:x1,y1,x2,y2,METRES)"
        )
    sizes = _fit(unit, seen, Hypotheses.of(common_bodies() if bodies is None else bodies))
    first = seen.first_guess
    evidence = _evidence(sizes, first + _GRID)
    best = int(evidence.sum(axis=0).argmax())
    explained = int(np.count_nonzero(evidence[:, best] > np.log(2 * _UNKNOWN)))
    if explained < _FEWEST or best in (0, len(_GRID) - 1):
        raise CalibrationError(
            f"scale: {explained} of {len(seen.sizes)} silhouettes look like vehicles along the road, at least "
            f"{_FEWEST} are needed; use more of the video, or a known distance (--scale distance:x1,y1,x2,y2,METRES)"
        )
    sigma = first + _vertex(evidence.sum(axis=0), best)
    return ScaleEstimate(
        float(np.exp(-sigma)),
        explained,
        _spread(evidence, seen.times_s, seed),
        "auto-models",
        {"silhouettes": len(seen.sizes), "explained": explained},
    )


def _measure(unit: Camera, blobs: Sequence[Blob]) -> Silhouettes:
    assert unit.image_wh is not None
    least = _SMALLEST * unit.image_wh[0]
    sizes = np.array([np.sqrt(cv2.contourArea(b.polygon_px.astype(np.float32))) for b in blobs])
    chosen = [blobs[i] for i in np.argsort(-sizes, kind="stable").tolist() if sizes[i] >= least]
    seen, _ = measure(unit, chosen, np.arange(len(chosen)))
    return seen.only(np.arange(len(seen.sizes)) < _MOST)


def _fit(unit: Camera, seen: Silhouettes, hypotheses: Hypotheses) -> _Sizes:
    fit = improve(unit, seen, hypotheses, first_fit(seen, hypotheses), _STEPS_BEFORE_CHOICE)
    score = _scores(unit, seen, hypotheses, fit)[0]
    best = np.maximum.reduceat(score, np.searchsorted(fit.vehicle, np.arange(len(seen.sizes))))
    fit = improve(
        unit, seen, hypotheses, fit.only(score > best[fit.vehicle] - _HOPELESS), _STEPS - _STEPS_BEFORE_CHOICE
    )
    score, variance = _scores(unit, seen, hypotheses, fit)
    return _Sizes(fit.vehicle, fit.shape[:, 0], variance, score)


def _scores(unit: Camera, seen: Silhouettes, hypotheses: Hypotheses, fit: Fit) -> tuple[Array, Array]:
    """(P,) log of how well each pair fits, very low for a fit that failed; and the variance of its size's logarithm."""
    found = residuals(unit, seen, hypotheses, fit)
    normal, _ = with_priors(fit, *eliminate(fit, found, found.slopes[..., 2:])[:2])
    variance = np.linalg.inv(normal)[:, 0, 0]
    score = hypotheses.log_prior[fit.hypothesis] - fit.over_pairs(found.costs()) - prior_costs(fit)
    good = np.isfinite(score) & np.isfinite(variance) & (variance > 0)
    return np.where(good, score, -1e6), np.where(good, variance, 1.0)


def _evidence(sizes: _Sizes, sigmas: Array) -> Array:
    """(N, S) log of how well each scale explains each silhouette."""
    miss = (sigmas - sizes.sigma[:, None]) ** 2 / (2 * sizes.variance[:, None])
    starts = np.flatnonzero(np.diff(sizes.silhouette, prepend=-1))
    logs = np.logaddexp.reduceat(sizes.score[:, None] - miss, starts, axis=0)
    return np.asarray(np.logaddexp(logs, np.log(_UNKNOWN)))


def _vertex(total: Array, best: int) -> float:
    """The grid's offset at the top of a parabola through the best value and its neighbours."""
    before, at, after = total[best - 1 : best + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(_GRID[best] + np.clip(shift, -0.5, 0.5) * (_GRID[1] - _GRID[0]))


def _spread(evidence: Array, times_s: Array, seed: int) -> float:
    """Standard deviation of the best scale's logarithm when stretches of the video are drawn anew."""
    rng = np.random.default_rng(seed)
    sums = np.array([evidence[block].sum(axis=0) for block in time_blocks(times_s, _BLOCK_S)])
    draws: NDArray[np.int64] = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), size=_RESAMPLES)
    return float(_GRID[(draws @ sums).argmax(axis=1)].std())
