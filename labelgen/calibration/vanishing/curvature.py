"""Whether the road bends: two signs that have to agree, since each alone has innocent causes.

Straight ways stay straight in a picture, so tracks that are bent there tell a bend, or a lens, or a lane change. And
on a bend vehicles head elsewhere far away than nearby; so they do where a slip road leaves. A bend shows both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from labelgen.calibration.vanishing.vp1 import TrackLines, Travel, planes_of, sideways, spread_of, weighted_quantile
from labelgen.geometry.homography import Array, homogeneous

__all__ = ["bend_deg"]

_ITERATIONS = 40
_LEAST_DEPTH = 0.02
_WANDER = 0.01
_TUKEY = 3.0


def bend_deg(lines: TrackLines, travel: Travel, weights: ArrayLike) -> float:
    """By how many degrees the road turns, positive to the right on its way ahead; about 0 where it is straight.

    Args:
        lines: N tracks.
        travel: the direction they share.
        weights: (N,) importance of each track.
    """
    given = np.asarray(weights, dtype=np.float64)
    turned, heads = _turn_deg(lines, given), _heading_change_deg(lines, travel.direction, given)
    return float(np.sign(turned) * min(abs(turned), abs(heads))) if turned * heads > 0 else 0.0


def _turn_deg(lines: TrackLines, weights: Array) -> float:
    """Median angle in the picture between the near and the far half of the longer tracks."""
    long = lines.length >= np.median(lines.length)
    near, far = lines.halves[long, 0], lines.halves[long, 1]
    way = far[:, :2] - near[:, :2]
    a, b = (d[:, 2:] * np.where((d[:, 2:] * way).sum(axis=1) < 0, -1, 1)[:, None] for d in (near, far))
    angle = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return float(np.degrees(weighted_quantile(angle, weights[long], 0.5)))


def _heading_change_deg(lines: TrackLines, start: Array, weights: Array) -> float:
    """How much the heading changes over the road that is seen, at a steady rate per metre, fitted along with VP1."""
    centre, direction = (lines.halves[:, :, part].reshape(-1, 2) for part in (slice(0, 2), slice(2, 4)))
    planes = planes_of(centre, direction)
    middle = homogeneous(centre)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    given, length, scatter = (np.repeat(a, 2) for a in (weights, lines.length / 2, lines.scatter))
    v, rate, limit, extent = start, 0.0, 6.0, 0.0
    for _ in range(_ITERATIONS):
        # How far away a place of the road is, in heights of the camera, goes with one over its depth below the horizon.
        depth = (centre[:, 1] * v[2] - v[1]) / (v[2] if abs(v[2]) > 1e-3 else 1e-3)
        far = 1 / np.maximum(depth, _LEAST_DEPTH)
        extent = weighted_quantile(far, given, 0.95) - weighted_quantile(far, given, 0.05)
        side = planes @ sideways(v)
        turn = (far - weighted_quantile(far, given, 0.5)) * side
        distance = np.sqrt(np.maximum(1 - (middle @ v) ** 2, 1e-6))
        noise = np.hypot((scatter + lines.pixel) * distance / length, _WANDER * side)
        z = (planes @ v + rate * turn) / noise
        limit = max(_TUKEY * spread_of(z, given), 0.7 * limit)
        used = given * np.maximum(1 - (z / limit) ** 2, 0) ** 2 / noise**2
        both = np.column_stack([planes, turn])
        normal = (both * used[:, None]).T @ both
        inverse = 1 / (normal[3, 3] + 1e-9)
        _, vectors = np.linalg.eigh(normal[:3, :3] - inverse * np.outer(normal[:3, 3], normal[3, :3]))
        new = vectors[:, 0] * (np.sign(vectors[:, 0] @ v) or 1.0)
        rate = -float(normal[3, :3] @ new) * inverse
        done = np.abs(new - v).max() < 1e-8
        v = new
        if done:
            break
    return float(np.degrees(rate * extent))
