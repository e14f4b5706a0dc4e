"""Models of vehicles laid over silhouettes: placed on the road, turned along VP1, moved, scaled and stretched.

Silhouettes of one vehicle share its size and proportions, and each has a place of its own. Outlines are compared as
convex hulls through their support: how far each reaches in evenly spread directions. Which type a vehicle is, and which
way it drives, is not known: every such hypothesis is fitted beside the others, a pair of vehicle and hypothesis at a
time.

Source: Sochor et al., CVIU 2017 (models aligned with detections); the fit is this project's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.silhouettes import Blob
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import SIZE_SPREAD, Body

__all__ = [
    "Fit",
    "Hypotheses",
    "Residuals",
    "Silhouettes",
    "eliminate",
    "first_fit",
    "improve",
    "measure",
    "prior_costs",
    "reach_by",
    "residuals",
    "with_priors",
]

Floats = NDArray[np.floating[Any]]

_TURNS = 2 * np.pi * np.arange(24) / 24
_DIRECTIONS = np.stack([np.cos(_TURNS), np.sin(_TURNS)])
# At its lowest point a silhouette holds some of the shadow beneath the vehicle, not at its lower corners, and on the
# whole it is a little larger or smaller than the vehicle: mean and standard deviation of both, in shares of its size.
# The first mean is that of background masks on rendered sessions.
_BEYOND = np.stack([np.maximum(_DIRECTIONS[1], 0) ** 20, np.ones(len(_TURNS))], axis=1)
_SHADOW, _SWELL = (0.035, 0.04), (0.003, 0.01)
# An outline's error: this much of the frame's width, and this share of the silhouette's size.
_ERROR_FRAME, _ERROR_SHARE = 1.6e-3, 0.02
# Neighbouring directions err together: so many of them are worth one measurement each.
_WORTH = 10 / len(_TURNS)
_HUBER = 2.0
_LONGEST_STEP = 0.2
_TYPICAL_WIDTH_M, _TYPICAL_HALF_LENGTH_M = 1.9, 2.2
# Shape parameters: log of units per metre, of the stretch along each axis; shadow, swelling. The size is left free.
_EXPECTED = np.array([0, 0, 0, 0, _SHADOW[0], _SWELL[0]])
_PRECISION = np.array([0, *(1 / spread**2 for spread in (*SIZE_SPREAD, _SHADOW[1], _SWELL[1]))])
# What a vehicle none of whose sightings counts is held by.
_HOLD = np.array([1e-3, 0, 0, 0, 0, 0])
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """N silhouettes of V vehicles.

    Args:
        support: (N, M) px, how far each reaches in M directions.
        sizes: (N,) px, square root of the area.
        feet: (N, 2) road units, middle of the lower side.
        widths: (N,) road units of the lower side.
        times_s: (N,).
        vehicles: (N,) 0 to V - 1.
    """

    support: Array
    sizes: Array
    feet: Array
    widths: Array
    times_s: Array
    vehicles: NDArray[np.int64]

    def only(self, kept: NDArray[np.bool_]) -> Silhouettes:
        """Those of some of the silhouettes (N,)."""
        parts = {f.name: getattr(self, f.name)[kept] for f in fields(self)}
        return replace(self, **parts | {"vehicles": np.unique(parts["vehicles"], return_inverse=True)[1]})

    @property
    def first_guess(self) -> float:
        """Log of units per metre: rather too large, for a vehicle seen from the side is as wide as it is long."""
        return float(np.median(np.log(self.widths / _TYPICAL_WIDTH_M)))


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """H types of vehicle and ways to drive.

    Args:
        points: (H, V, 3) metres, each body driving away and towards the camera, filled up to one number of points.
        log_prior: (H,).
    """

    points: Array
    log_prior: Array

    @classmethod
    def of(cls, bodies: Sequence[Body]) -> Hypotheses:
        """Each body, both ways."""
        count = max(len(body.points) for body in bodies)
        filled = [np.concatenate([b.points, np.repeat(b.points[:1], count - len(b.points), axis=0)]) for b in bodies]
        turned = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]])
        points = np.concatenate([p * turned[:, None] for p in filled])
        return cls(points, np.log([body.share / 2 for body in bodies for _ in range(2)]))


@dataclass(frozen=True, eq=False)
class Fit:
    """P pairs of a vehicle and a hypothesis, and R sightings of pairs, in the pairs' order.

    Args:
        vehicle, hypothesis: (P,).
        shape: (P, 6) log of units per metre and of the stretch along each axis; shadow, swelling.
        silhouette, pair: (R,).
        place: (R, 2) on the road, units.
        worth: (R,) 1 or 0, whether the sighting counts.
    """

    vehicle: NDArray[np.int64]
    hypothesis: NDArray[np.int64]
    shape: Array
    silhouette: NDArray[np.int64]
    pair: NDArray[np.int64]
    place: Array
    worth: Array

    def only(self, kept: NDArray[np.bool_]) -> Fit:
        """Some of the pairs (P,)."""
        rows = kept[self.pair]
        number = np.cumsum(kept) - 1
        return Fit(
            self.vehicle[kept],
            self.hypothesis[kept],
            self.shape[kept],
            self.silhouette[rows],
            number[self.pair[rows]],
            self.place[rows],
            self.worth[rows],
        )

    def over_pairs(self, values: Array) -> Array:
        """(P, ...) sums of values (R, ...) over each pair's sightings."""
        starts = np.searchsorted(self.pair, np.arange(len(self.vehicle)))
        return np.asarray(np.add.reduceat(values, starts, axis=0))


@dataclass(frozen=True, eq=False)
class Residuals:
    """How a fit misses.

    Args:
        miss: (R, M) in standard deviations.
        slopes: (R, M, 8) of the prediction, in the same: place, then shape.
        weights: (R, M).
        error: (R,) px, the standard deviation.
        outline: (R, M, 3) metres, the model's points that reach farthest.
    """

    miss: Array
    slopes: Array
    weights: Array
    error: Array
    outline: Array

    def costs(self) -> Array:
        """(R,) half the robust sum of squares."""
        size = np.abs(self.miss)
        robust = np.where(size < _HUBER, size**2 / 2, _HUBER * (size - _HUBER / 2)).sum(axis=-1)
        return np.asarray(_WORTH * robust)


def measure(unit: Camera, blobs: Sequence[Blob], vehicles: NDArray[np.int64]) -> tuple[Silhouettes, NDArray[np.int64]]:
    """Silhouettes of blobs that stand on the road, in the order of their vehicles.

    Args:
        unit: camera, scale 1.
        blobs: B of them.
        vehicles: (B,) number of each blob's vehicle, any numbers.

    Returns:
        the silhouettes, and which blobs they are (N,).
    """
    order = np.argsort(vehicles, kind="stable")
    polygons = [blobs[i].polygon_px for i in order.tolist()]
    low = np.array([p.min(axis=0) for p in polygons]).reshape(-1, 2)
    high = np.array([p.max(axis=0) for p in polygons]).reshape(-1, 2)
    left, right = (unit.road_points(np.stack([x, high[:, 1]], axis=1), invalid="nan") for x in (low[:, 0], high[:, 0]))
    widths = np.linalg.norm(right - left, axis=1)
    kept = np.flatnonzero(np.isfinite(widths) & (widths > 0))
    chosen = order[kept]
    return Silhouettes(
        np.array([(polygons[k] @ _DIRECTIONS).max(axis=0) for k in kept.tolist()]).reshape(-1, len(_TURNS)),
        np.array([np.sqrt(cv2.contourArea(polygons[k].astype(np.float32))) for k in kept.tolist()]),
        ((left + right) / 2)[kept],
        widths[kept],
        np.array([blobs[i].time_s for i in chosen.tolist()]),
        np.unique(vehicles[chosen], return_inverse=True)[1],
    ), chosen


def first_fit(seen: Silhouettes, hypotheses: Hypotheses) -> Fit:
    """Every pair, with the size guessed from the widths."""
    vehicles, kinds = int(seen.vehicles.max()) + 1, len(hypotheses.log_prior)
    # Sightings in the order of the pairs, which are in the order of the vehicles.
    key = (seen.vehicles[:, None] * kinds + np.arange(kinds)).ravel()
    order = np.argsort(key, kind="stable")
    shape = np.tile(_EXPECTED, (vehicles * kinds, 1))
    shape[:, 0] = seen.first_guess
    silhouette = np.repeat(np.arange(len(seen.sizes)), kinds)[order]
    place = seen.feet[silhouette] + [_TYPICAL_HALF_LENGTH_M * np.exp(seen.first_guess), 0.0]
    return Fit(
        np.repeat(np.arange(vehicles), kinds),
        np.tile(np.arange(kinds), vehicles),
        shape,
        silhouette,
        key[order],
        place,
        np.ones(len(silhouette)),
    )


def improve(unit: Camera, seen: Silhouettes, hypotheses: Hypotheses, fit: Fit, steps: int) -> Fit:
    """Gauss-Newton for all pairs at once."""
    for _ in range(steps):
        found = residuals(unit, seen, hypotheses, fit)
        normal, pull, back = eliminate(fit, found, found.slopes[..., 2:])
        normal, pull = with_priors(fit, normal, pull)
        change = np.clip(np.linalg.solve(normal, pull[..., None])[..., 0], -_LONGEST_STEP, _LONGEST_STEP)
        moved = back[..., -1] - np.einsum("rij,rj->ri", back[..., :-1], change[fit.pair])
        longest = 4 * np.exp(fit.shape[fit.pair, :1])
        fit = replace(fit, shape=fit.shape + change, place=fit.place + np.clip(moved, -longest, longest))
    return fit


def eliminate(fit: Fit, found: Residuals, slopes: Array) -> tuple[Array, Array, Array]:
    """Normal equations of K parameters that a pair's sightings share, with each sighting's place eliminated.

    Args:
        fit: of P pairs and R sightings.
        found: its residuals.
        slopes: (R, M, K) of the prediction by these parameters, in standard deviations.

    Returns:
        (P, K, K) and (P, K), without priors; (R, 2, K + 1), which times the change of the parameters gives the places'
        change: the last column less the others times it.
    """
    own = found.slopes[..., :2]
    weighted = own * found.weights[..., None]
    a, b, c = weighted[..., 0], weighted[..., 1], np.swapaxes(weighted, -1, -2)
    xx, yy = ((w * own[..., k]).sum(axis=-1) + _TINY for k, w in enumerate((a, b)))
    xy = (a * own[..., 1]).sum(axis=-1)
    inverse = np.stack([np.stack([yy, -xy], -1), np.stack([-xy, xx], -1)], -2) / (xx * yy - xy**2)[:, None, None]
    right = c @ np.concatenate([slopes, found.miss[..., None]], axis=-1)
    back = inverse @ right
    shared = np.swapaxes(slopes * found.weights[..., None], -1, -2)
    full = shared @ np.concatenate([slopes, found.miss[..., None]], axis=-1)
    full -= np.swapaxes(right[..., :-1], -1, -2) @ back
    total = fit.over_pairs(full)
    return total[..., :-1], total[..., -1], back


def with_priors(fit: Fit, normal: Array, pull: Array) -> tuple[Array, Array]:
    """Normal equations (P, K, K), (P, K) whose first 6 parameters are the shape, with what is known of it."""
    count = len(_PRECISION)
    normal, pull = normal.copy(), pull.copy()
    normal[:, :count, :count] += np.diag(_PRECISION + _HOLD)
    pull[:, :count] -= _PRECISION * (fit.shape - _EXPECTED)
    return normal, pull


def prior_costs(fit: Fit) -> Array:
    """(P,) what the proportions, the shadow and the swelling cost."""
    return np.asarray((_PRECISION * (fit.shape - _EXPECTED) ** 2).sum(axis=-1) / 2)


def residuals(unit: Camera, seen: Silhouettes, hypotheses: Hypotheses, fit: Fit) -> Residuals:
    """How the models miss the silhouettes, and which way that changes."""
    assert unit.image_wh is not None
    shape = fit.shape[fit.pair]
    stretch = np.exp(shape[:, :1] + shape[:, 1:4])
    points = hypotheses.points[fit.hypothesis[fit.pair]]
    # Single precision finds the same points, give or take a hair, in half the time.
    pixels = _pixels(unit, *(part.astype(np.float32) for part in (points, stretch, fit.place)))[0]
    farthest = (_DIRECTIONS.T.astype(np.float32) @ np.swapaxes(pixels, -1, -2)).argmax(axis=-1)
    outline = np.take_along_axis(points, farthest[..., None], axis=1)
    sizes = seen.sizes[fit.silhouette]
    error = np.hypot(_ERROR_FRAME * unit.image_wh[0], _ERROR_SHARE * sizes)
    reach, slopes = _support(unit, outline, stretch, fit.place)
    beyond = _BEYOND * sizes[:, None, None]
    reach += np.einsum("rmi,ri->rm", beyond, shape[:, 4:])
    miss = (seen.support[fit.silhouette] - reach) / error[:, None]
    weights = _WORTH * fit.worth[:, None] / np.maximum(1, np.abs(miss) / _HUBER)
    slopes = np.concatenate([slopes, beyond], axis=-1) / error[:, None, None]
    return Residuals(miss, slopes, weights, error, outline)


def reach_by(unit: Camera, outline: Array, fit: Fit) -> Array:
    """(R, M) px, how far the models' outlines (R, M, 3) reach through another camera, without shadow and swelling."""
    shape = fit.shape[fit.pair]
    pixels, _, _ = _pixels(unit, outline, np.exp(shape[:, :1] + shape[:, 1:4]), fit.place)
    return np.asarray(np.einsum("rmi,im->rm", pixels, _DIRECTIONS))


def _pixels(unit: Camera, points: Floats, stretch: Floats, place: Floats) -> tuple[Floats, Floats, Floats]:
    """Points (R, V, 3) m in the image (R, V, 2) px, at the camera and on the road (R, V, 3) units.

    All in the precision of the points.
    """
    own = points * stretch[:, None]
    height = np.full((len(place), 1), -unit.height_m, dtype=place.dtype)
    places = own + np.concatenate([place, height], axis=1)[:, None]
    seen = places @ unit.axes.astype(points.dtype)
    seen[..., 2] = np.maximum(seen[..., 2], points.dtype.type(1e-6 * unit.focal))
    pixels = seen[..., :2] * (points.dtype.type(unit.focal) / seen[..., 2:])
    return pixels + unit.pp.astype(points.dtype), seen, own


def _support(unit: Camera, outline: Array, stretch: Array, place: Array) -> tuple[Array, Array]:
    """How far points (R, M, 3) reach, each in its direction (R, M) px, and the slopes (R, M, 6): place, size, stretch.

    The farthest point is the one whose move moves the support.
    """
    pixels, at, own = _pixels(unit, outline, stretch, place)
    dx, dy = _DIRECTIONS
    by_depth = unit.focal / at[..., 2]
    in_camera = np.stack(
        [by_depth * dx, by_depth * dy, -by_depth * (dx * at[..., 0] + dy * at[..., 1]) / at[..., 2]], -1
    )
    on_road = in_camera @ unit.axes.T
    by_size = on_road * own
    reach = np.einsum("rmi,im->rm", pixels, _DIRECTIONS)
    return reach, np.concatenate([on_road[..., :2], by_size.sum(axis=-1, keepdims=True), by_size], axis=-1)
