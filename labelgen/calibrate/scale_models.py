"""Scale from the forms of common vehicles: models are laid over the silhouettes, and the scale that suits most wins.

For each silhouette, type of vehicle and direction of travel, the model is placed on the road, turned along VP1, and
moved, scaled, and stretched within what vehicles of its type differ by, until its outline is that of the silhouette.
Outlines are compared as convex hulls through their support: how far each reaches in evenly spread directions. That
gives a scale, its variance, and how badly the model fits. One silhouette says little, for a small car near by and a
large one far away look much alike; but all share one scale, so the evidence of all is added up, each silhouette being
one of the types with the probability of that type in traffic, or nothing that is known at all: a merged pair, a
shadow, a lorry.

Source: Sochor et al., CVIU 2017 (models of common types, aligned with detections; there the type comes from a
classifier, and bounding boxes are compared).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibrate.blobs import Blob
from labelgen.calibrate.bodies import SIZE_SPREAD, Body, common_bodies
from labelgen.calibrate.scale import ScaleEstimate, time_blocks, unit_camera
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.projective import Array

__all__ = ["scale_from_models"]

_TURNS = 2 * np.pi * np.arange(24) / 24
_DIRECTIONS = np.stack([np.cos(_TURNS), np.sin(_TURNS)])
# Downwards a silhouette holds some of the shadow beneath the vehicle, and on the whole it is a little larger or
# smaller than the vehicle: mean and standard deviation of both, in shares of its size. The first mean is that of
# background masks on rendered sessions.
_DOWN = np.maximum(_DIRECTIONS[1], 0)
_SHADOW, _SWELL = (0.022, 0.04), (0.003, 0.01)
# An outline's error: this much of the frame's width, and this share of the silhouette's size.
_ERROR_FRAME, _ERROR_SHARE = 1.6e-3, 0.02
# Neighbouring directions err together: so many of them are worth one measurement each.
_INDEPENDENT = 10
_HUBER = 2.0
_STEPS = 8
_LONGEST_STEP = 0.2
# Silhouettes smaller than this share of the frame's width say too little, and more than so many of them no more.
_SMALLEST, _MOST = 0.025, 300
_UNKNOWN = 1e-3
_TYPICAL_WIDTH_M = 1.9
_TYPICAL_HALF_LENGTH_M = 2.2
# Sizes tried, as the logarithm of their ratio to the first guess, which is too large rather than too small: the
# silhouette of a vehicle seen from the side is as wide as it is long.
_GRID = np.linspace(-1.6, 0.8, 1201)
_FEWEST = 8
_BLOCK_S = 5.0
_RESAMPLES = 100


@dataclass(frozen=True, eq=False)
class _Silhouettes:
    """N silhouettes: support (N, M) px, sizes (N,) px, feet (N, 2) road units, widths (N,) units, times (N,) s."""

    support: Array
    sizes: Array
    feet: Array
    widths: Array
    times_s: Array


@dataclass(frozen=True, eq=False)
class _Fits:
    """Per silhouette and hypothesis (N, H): log of units per metre, its variance, cost of the fit; prior (H,), log."""

    sigma: Array
    variance: Array
    cost: Array
    prior: Array


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
    fits = _fit(unit, seen, common_bodies() if bodies is None else bodies)
    first = float(np.median(np.log(seen.widths / _TYPICAL_WIDTH_M)))
    evidence = _evidence(fits, first + _GRID)
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


def _measure(unit: Camera, blobs: Sequence[Blob]) -> _Silhouettes:
    assert unit.image_wh is not None
    least = _SMALLEST * unit.image_wh[0]
    sizes = np.array([np.sqrt(cv2.contourArea(b.polygon_px.astype(np.float32))) for b in blobs])
    chosen = [i for i in np.argsort(-sizes, kind="stable").tolist() if sizes[i] >= least]
    low = np.array([blobs[i].polygon_px.min(axis=0) for i in chosen]).reshape(-1, 2)
    high = np.array([blobs[i].polygon_px.max(axis=0) for i in chosen]).reshape(-1, 2)
    left, right = (unit.road_points(np.stack([x, high[:, 1]], axis=1), invalid="nan") for x in (low[:, 0], high[:, 0]))
    widths = np.linalg.norm(right - left, axis=1)
    on_road = np.flatnonzero(np.isfinite(widths) & (widths > 0))[:_MOST]
    kept = [chosen[i] for i in on_road.tolist()]
    return _Silhouettes(
        np.array([(blobs[i].polygon_px @ _DIRECTIONS).max(axis=0) for i in kept]).reshape(-1, len(_TURNS)),
        sizes[kept],
        (left + right)[on_road] / 2,
        widths[on_road],
        np.array([blobs[i].time_s for i in kept]),
    )


def _fit(unit: Camera, seen: _Silhouettes, bodies: Sequence[Body]) -> _Fits:
    """Gauss-Newton for all silhouettes and hypotheses at once."""
    assert unit.image_wh is not None
    points = _hypotheses(bodies)
    prior = np.log([body.share / 2 for body in bodies for _ in range(2)])
    precision = np.array([0, 0, 0, *(1 / spread**2 for spread in (*SIZE_SPREAD, _SHADOW[1], _SWELL[1]))])
    expected = np.array([0, 0, 0, 0, 0, 0, _SHADOW[0], _SWELL[0]])
    error = np.hypot(_ERROR_FRAME * unit.image_wh[0], _ERROR_SHARE * seen.sizes)[:, None, None]
    worth = _INDEPENDENT / len(_TURNS)
    first = float(np.median(np.log(seen.widths / _TYPICAL_WIDTH_M)))
    # Parameters: X and Y on the road, log of units per metre, and of the stretch along each axis; shadow and swelling.
    theta = np.tile(expected, (len(seen.sizes), len(points), 1))
    theta[..., :2], theta[..., 2] = seen.feet[:, None], first
    theta[..., 0] += _TYPICAL_HALF_LENGTH_M * np.exp(first)
    for step in range(_STEPS + 1):
        reach, slopes = _support(unit, points, theta[..., :6])
        beyond = np.stack([_DOWN, np.ones_like(_DOWN)], axis=1) * seen.sizes[:, None, None]
        reach += np.einsum("nmi,nhi->nhm", beyond, theta[..., 6:])
        beyond = np.broadcast_to(beyond[:, None], (*slopes.shape[:3], 2))
        slopes = np.concatenate([slopes, beyond], axis=-1)
        misses = (seen.support[:, None] - reach) / error
        if step == _STEPS:
            break
        slopes /= error[..., None]
        weights = worth / np.maximum(1, np.abs(misses) / _HUBER)
        normal = np.swapaxes(slopes * weights[..., None], -1, -2) @ slopes + np.diag(precision)
        pull = np.einsum("nhmi,nhm->nhi", slopes, weights * misses) - precision * (theta - expected)
        change = np.linalg.solve(normal, pull[..., None])[..., 0]
        change[..., 2:] = np.clip(change[..., 2:], -_LONGEST_STEP, _LONGEST_STEP)
        longest = 4 * np.exp(theta[..., 2:3])
        change[..., :2] = np.clip(change[..., :2], -longest, longest)
        theta += change
    size = np.abs(misses)
    robust = np.where(size < _HUBER, size**2 / 2, _HUBER * (size - _HUBER / 2)).sum(axis=-1)
    cost = worth * robust + (precision * (theta - expected) ** 2).sum(axis=-1) / 2
    variance = np.linalg.inv(normal)[..., 2, 2]
    bad = ~(np.isfinite(cost) & np.isfinite(variance) & (variance > 0))
    return _Fits(np.where(bad, 0, theta[..., 2]), np.where(bad, 1, variance), np.where(bad, 1e6, cost), prior)


def _hypotheses(bodies: Sequence[Body]) -> Array:
    """(H, V, 3) metres: each body driving away and towards the camera, filled up to one number of points."""
    count = max(len(body.points) for body in bodies)
    filled = [np.concatenate([b.points, np.repeat(b.points[:1], count - len(b.points), axis=0)]) for b in bodies]
    turned = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]])
    return np.concatenate([points * turned[:, None] for points in filled])


def _support(unit: Camera, points: Array, theta: Array) -> tuple[Array, Array]:
    """How far models reach in the image in each direction (N, H, M) px, and the slopes of that (N, H, M, 6)."""
    stretch = np.exp(theta[..., 2:3] + theta[..., 3:])
    places = points * stretch[..., None, :]
    places[..., :2] += theta[..., None, :2]
    places[..., 2] -= unit.height_m
    seen = places @ unit.axes
    depth = np.maximum(seen[..., 2:], 1e-6 * unit.focal)
    pixels = unit.pp + unit.focal * seen[..., :2] / depth
    reaches = pixels @ _DIRECTIONS
    farthest = reaches.argmax(axis=2)
    reach = np.take_along_axis(reaches, farthest[:, :, None], axis=2)[:, :, 0]
    # The farthest point is the one whose move moves the support.
    at = np.take_along_axis(np.concatenate([seen[..., :2], depth], axis=-1), farthest[..., None], axis=2)
    own = np.take_along_axis(points[None] * stretch[..., None, :], farthest[..., None], axis=2)
    dx, dy = _DIRECTIONS
    by_depth = unit.focal / at[..., 2]
    in_camera = np.stack(
        [by_depth * dx, by_depth * dy, -by_depth * (dx * at[..., 0] + dy * at[..., 1]) / at[..., 2]], -1
    )
    on_road = in_camera @ unit.axes.T
    by_size = on_road * own
    return reach, np.concatenate([on_road[..., :2], by_size.sum(axis=-1, keepdims=True), by_size], axis=-1)


def _evidence(fits: _Fits, sigmas: Array) -> Array:
    """(N, S) log of how well each scale explains each silhouette."""
    miss = (sigmas - fits.sigma[..., None]) ** 2 / (2 * fits.variance[..., None])
    logs = (fits.prior - fits.cost)[..., None] - miss
    return np.asarray(np.logaddexp(np.logaddexp.reduce(logs, axis=1), np.log(_UNKNOWN)))


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
