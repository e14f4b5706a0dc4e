"""VP1, the vanishing point of the direction of travel: the point that the tracks of vehicles have in common.

The lines of the tracks vote in diamond space, and the peak is refined by reweighted least squares on the sphere of
directions, where points at infinity need no special case. Vehicles of both directions of travel share one VP1.

Convention: normalised coordinates, as in `track_lines`.

Source: Dubska et al., BMVC 2014, section 2 (tracks of features, diamond space).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.calibration.vanishing.diamond_space import accumulate, peak
from labelgen.calibration.vanishing.robust import robust_sd, tukey_weights
from labelgen.calibration.vanishing.track_lines import TrackLines
from labelgen.geometry.homography import Array, homogeneous

__all__ = ["Vp1Estimate", "Vp1Settings", "estimate_vp1", "horizon_tangent", "refine_vp1"]


@dataclass(frozen=True)
class Vp1Settings:
    """How VP1 is estimated."""

    max_vote_length: float = 0.25
    """A line's vote grows with its length up to this, in units: no single long track decides."""
    iterations: int = 60
    """Most steps of the reweighted fit."""
    convergence: float = 1e-9
    """Change of the unit vector to VP1 below which the fit ends."""
    min_heading_sd: float = 0.002
    """Least standard deviation of the vehicles' headings about VP1, rad."""
    max_heading_sd: float = 0.01
    """Largest one, rad, from which the fit starts; with larger values VP1's place along the horizon is less certain."""
    noise_px: float = 1.0
    """Standard deviation of a feature's position, px, beside a track's own scatter."""
    start_limit: float = 6.0
    """Residual, in standard deviations, without weight in the first step: the start is rough."""
    limit_decay: float = 0.7
    """Factor by which this limit shrinks per step at most."""
    tukey: float = 3.0
    """The limit in the end, in robust standard deviations of the residuals."""
    max_heading_deg: float = 5.0
    """A track within this deviation goes along the road, degrees: lanes merge, and drivers change them."""
    inlier_sd: float = 3.0
    """So does one within this many standard deviations of its noise."""


@dataclass(frozen=True, eq=False)
class Vp1Estimate:
    """A direction of travel.

    Args:
        direction: (3,) unit, homogeneous VP1 in normalised coordinates.
        inliers: (N,) which tracks point there.
        weights: (N,) of the tracks in the last fit.
        heading_sd_deg: standard deviation of the vehicles' own headings, degrees.
    """

    direction: Array
    inliers: NDArray[np.bool_]
    weights: Array
    heading_sd_deg: float


def estimate_vp1(
    lines: TrackLines, weights: ArrayLike | None = None, settings: Vp1Settings | None = None
) -> Vp1Estimate:
    """Estimate the direction that most tracks share, each track for itself.

    Args:
        lines: N > 1 tracks.
        weights: (N,) importance of each track; 1 without it.
        settings: thresholds.
    """
    settings = settings or Vp1Settings()
    given = np.ones(len(lines)) if weights is None else np.asarray(weights, dtype=np.float64)
    start, _ = peak(accumulate(lines.planes, given * np.minimum(lines.length, settings.max_vote_length)))
    return refine_vp1(lines, start, np.arange(len(lines)), given, settings)


def refine_vp1(
    lines: TrackLines,
    start: Array,
    vehicles: NDArray[np.int64],
    weights: ArrayLike | None = None,
    settings: Vp1Settings | None = None,
) -> Vp1Estimate:
    """Refine VP1 by reweighted least squares, each vehicle with a heading of its own.

    Lanes merge and drivers wander, so that the tracks of different vehicles are not quite parallel; features of one
    vehicle are. Each vehicle's lines therefore have to meet in a point of the horizon, and these points scatter about
    VP1 along the horizon with a standard deviation that is estimated too.

    Args:
        lines: N tracks.
        start: (3,) rough direction, homogeneous.
        vehicles: (N,) number of each track's vehicle.
        weights: (N,) importance of each track; 1 without it.
        settings: thresholds.
    """
    settings = settings or Vp1Settings()
    given = np.ones(len(lines)) if weights is None else np.asarray(weights, dtype=np.float64)
    planes = lines.planes
    middle = homogeneous(lines.centre)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    heading_sd_range = settings.min_heading_sd, settings.max_heading_sd
    v, limit, heading_sd, used = start / np.linalg.norm(start), settings.start_limit, heading_sd_range[1], given
    for _ in range(settings.iterations):
        side = planes @ horizon_tangent(v)
        distance = np.sqrt(np.maximum(1 - (middle @ v) ** 2, 1e-6))
        noise = (lines.scatter + settings.noise_px * lines.pixel) * distance / lines.length
        heading = _vehicle_headings(planes @ v, side, vehicles, used / noise**2, heading_sd)
        z = (planes @ v + heading * side) / noise
        # From a rough start the limit is wide; it narrows to the scatter of the tracks themselves.
        limit = max(settings.tukey * robust_sd(z, given), limit * settings.limit_decay)
        used = given * tukey_weights(z, limit)
        if np.count_nonzero(used) < 2:
            break
        heading_sd = float(np.clip(robust_sd(heading, used), *heading_sd_range))
        _, vectors = np.linalg.eigh(_normal_matrix(planes, side, vehicles, used / noise**2, heading_sd))
        new = vectors[:, 0] * (np.sign(vectors[:, 0] @ v) or 1.0)
        converged = np.abs(new - v).max() < settings.convergence
        v = new
        if converged:
            break
    allowed = np.hypot(np.radians(settings.max_heading_deg) * side, settings.inlier_sd * noise)
    return Vp1Estimate(v, np.abs(planes @ v) < allowed, used, float(np.degrees(heading_sd)))


def horizon_tangent(v: Array) -> Array:
    """Return the unit direction (3,) along a level horizon at VP1 (3,): where VP1 moves when a vehicle turns."""
    side = np.array([v[2], 0.0, -v[0]])
    length = float(np.linalg.norm(side))
    return side / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def _vehicle_headings(off: Array, side: Array, vehicles: NDArray[np.int64], weights: Array, heading_sd: float) -> Array:
    """Return the heading (N,) of each track's vehicle, rad to the side of VP1, with a prior of heading_sd about 0."""
    top = np.bincount(vehicles, weights * side * off)
    bottom = np.bincount(vehicles, weights * side**2) + heading_sd**-2
    return np.asarray((-top / bottom)[vehicles])


def _normal_matrix(planes: Array, side: Array, vehicles: NDArray[np.int64], weights: Array, heading_sd: float) -> Array:
    """Return the normal matrix (3, 3) for VP1 with each vehicle's heading eliminated."""
    along = np.stack([np.bincount(vehicles, weights * side * planes[:, k]) for k in range(3)], axis=1)
    bottom = np.bincount(vehicles, weights * side**2) + heading_sd**-2
    return np.asarray((planes * weights[:, None]).T @ planes - (along / bottom[:, None]).T @ along)
