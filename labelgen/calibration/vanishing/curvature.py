"""Curvature of the road, from two measurements that must agree.

The first is the curvature of tracks in the image. A bend of the road causes it, but so do lens distortion and changes
of lane. The second is the change of the vehicles' heading with their distance. A bend causes it, but so does a slip
road. Only a bend causes both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from labelgen.calibration.vanishing.robust import robust_sd, tukey_weights, weighted_quantile
from labelgen.calibration.vanishing.track_lines import TrackLines, interpretation_planes
from labelgen.calibration.vanishing.vp1 import Vp1Estimate, horizon_tangent
from labelgen.geometry.homography import Array, homogeneous

__all__ = ["CurvatureSettings", "estimate_curvature_deg"]


@dataclass(frozen=True)
class CurvatureSettings:
    """How the curvature of the road is measured."""

    iterations: int = 40
    """Most steps of the reweighted fit."""
    convergence: float = 1e-8
    """Change of the unit vector to VP1 below which the fit ends."""
    min_depth: float = 0.02
    """Least depth below the horizon, in units: it bounds the distance of what is farthest away."""
    heading_sd: float = 0.01
    """Standard deviation of the vehicles' headings, rad."""
    start_limit: float = 6.0
    """Residual, in standard deviations, without weight in the first step: the start is rough."""
    limit_decay: float = 0.7
    """Factor by which this limit shrinks per step at most."""
    tukey: float = 3.0
    """The limit in the end, in robust standard deviations of the residuals."""
    extent_quantile: float = 0.05
    """Share of the tracks at either end of the road that its extent leaves out."""


def estimate_curvature_deg(
    lines: TrackLines, vp1: Vp1Estimate, weights: ArrayLike, settings: CurvatureSettings | None = None
) -> float:
    """Return by how many degrees the road turns, positive to the right on its way ahead; about 0 where it is straight.

    Args:
        lines: N tracks.
        vp1: the direction they share.
        weights: (N,) importance of each track.
        settings: thresholds.
    """
    settings = settings or CurvatureSettings()
    given = np.asarray(weights, dtype=np.float64)
    turn, heading = _image_turn_deg(lines, given), _heading_change_deg(lines, vp1.direction, given, settings)
    return float(np.sign(turn) * min(abs(turn), abs(heading))) if turn * heading > 0 else 0.0


def _image_turn_deg(lines: TrackLines, weights: Array) -> float:
    """Return the median angle in the image between the near and the far half of the longer tracks, degrees."""
    long = lines.length >= np.median(lines.length)
    near, far = lines.halves[long, 0], lines.halves[long, 1]
    between = far[:, :2] - near[:, :2]
    a, b = (d[:, 2:] * np.where((d[:, 2:] * between).sum(axis=1) < 0, -1, 1)[:, None] for d in (near, far))
    angle = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return float(np.degrees(weighted_quantile(angle, weights[long], 0.5)))


def _heading_change_deg(lines: TrackLines, start: Array, weights: Array, settings: CurvatureSettings) -> float:
    """Return the change of heading over the visible road, degrees: a steady rate per metre, fitted along with VP1."""
    centre, direction = (lines.halves[:, :, part].reshape(-1, 2) for part in (slice(0, 2), slice(2, 4)))
    planes = interpretation_planes(centre, direction)
    middle = homogeneous(centre)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    given, length, scatter = (np.repeat(a, 2) for a in (weights, lines.length / 2, lines.scatter))
    low, high = settings.extent_quantile, 1 - settings.extent_quantile
    v, rate, limit, extent = start, 0.0, settings.start_limit, 0.0
    for _ in range(settings.iterations):
        # The distance of a place on the road, in heights of the camera, goes with one over its depth below the horizon.
        depth = (centre[:, 1] * v[2] - v[1]) / (v[2] if abs(v[2]) > 1e-3 else 1e-3)
        far = 1 / np.maximum(depth, settings.min_depth)
        extent = weighted_quantile(far, given, high) - weighted_quantile(far, given, low)
        side = planes @ horizon_tangent(v)
        turn = (far - weighted_quantile(far, given, 0.5)) * side
        distance = np.sqrt(np.maximum(1 - (middle @ v) ** 2, 1e-6))
        noise = np.hypot((scatter + lines.pixel) * distance / length, settings.heading_sd * side)
        z = (planes @ v + rate * turn) / noise
        limit = max(settings.tukey * robust_sd(z, given), settings.limit_decay * limit)
        used = given * tukey_weights(z, limit) / noise**2
        both = np.column_stack([planes, turn])
        normal = (both * used[:, None]).T @ both
        inverse = 1 / (normal[3, 3] + 1e-9)
        _, vectors = np.linalg.eigh(normal[:3, :3] - inverse * np.outer(normal[:3, 3], normal[3, :3]))
        new = vectors[:, 0] * (np.sign(vectors[:, 0] @ v) or 1.0)
        rate = -float(normal[3, :3] @ new) * inverse
        converged = np.abs(new - v).max() < settings.convergence
        v = new
        if converged:
            break
    return float(np.degrees(rate * extent))
