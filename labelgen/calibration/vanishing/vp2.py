"""VP2, the direction across the road, and with it the focal length: what edges on vehicles say once VP1 is known.

VP1 leaves two unknowns: the tilt of the horizon, on which VP1 and VP2 lie, and the focal length, which fixes how far
apart they are for being orthogonal. Every pair of the two gives VP2 and VP3. Edges of vehicles run along, across and
up, or somewhere else; how probable all edges are together is computed for a grid of pairs. VP2 may lie at infinity:
then the tilt is all the edges tell, and the prior decides on the focal length, which the spread reports.

Convention: normalised coordinates (px - pp) / unit, as in `travel`. The tilt is the angle of the horizon in the
picture, rad, positive when it falls to the right. A focal length is in units.

Source: Dubska et al., BMVC 2014 (the constraint, diamond space); Sochor et al., CVIU 2017 (edges of vehicles). The
joint likelihood over tilt and focal length is this project's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = ["Across", "Edges", "directions", "edges_of", "find_across"]

# Priors: the horizon of a camera set up by people, and the lens. Focal lengths in widths of the picture.
_TILT_SD = np.radians(3.0)
_TILT_LIMIT = np.radians(12.0)
_FOCAL_MEDIAN, _FOCAL_SD = 1.2, 0.55
_FOCAL_LIMITS = (0.4, 5.0)
# Directions of edges: their own scatter, and that of an end point, px.
_EDGE_SD = np.radians(0.5)
_END_PX = 0.6
# Shares of the edges that run across, up, and anywhere.
_SHARES = (0.35, 0.1, 0.55)
_ALONG_DEG = 5.0
# Where the horizon may pass below (positive) and above the principal point, units.
_HORIZON_OFFSETS = (-3.0, 0.4)
_COARSE = 4000
# So many numbers fit into the processor's cache together with what is made of them, and no library spreads a product
# of that size over threads that wait for one another.
_AT_ONCE = 60_000


@dataclass(frozen=True, eq=False)
class Edges:
    """N edges, normalised: middles (N, 2), unit directions (N, 2), standard deviations (N,) rad, lengths (N,)."""

    middle: Array
    direction: Array
    deviation: Array
    length: Array

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Edges:
        return Edges(self.middle[kept], self.direction[kept], self.deviation[kept], self.length[kept])


@dataclass(frozen=True, eq=False)
class Across:
    """Tilt and focal length.

    Args:
        tilt: rad.
        focal: units.
        tilt_sd, focal_sd: spread of the posterior, rad and as a natural logarithm.
        support: edges that point to VP2 within 1.5 degrees, in excess of as many as chance would give.
        support_share: the same as a share of all edges not along the road.
    """

    tilt: float
    focal: float
    tilt_sd: float
    focal_sd: float
    support: float
    support_share: float


def edges_of(edgelets: Array, pp: Array, unit: float) -> Edges:
    """Edges from end points (N, >= 4) px."""
    ends = (edgelets[:, :4].reshape(-1, 2, 2) - pp) / unit
    way = ends[:, 1] - ends[:, 0]
    length = np.maximum(np.hypot(*way.T), 1e-9)
    deviation = np.hypot(_EDGE_SD, _END_PX / unit / length)
    return Edges(ends.mean(axis=1), way / length[:, None], deviation, length)


def directions(vp1: Array, tilt: Array, focal: Array) -> tuple[Array, Array]:
    """VP2 and VP3, homogeneous (..., 3), for VP1 (3,) and arrays of tilts and focal lengths.

    All in normalised coordinates; VP2 lies on the horizon through VP1 at that tilt, orthogonal to it.
    """
    tilt, focal = np.broadcast_arrays(tilt, focal)
    ray = np.stack([vp1[0] + 0 * focal, vp1[1] + 0 * focal, vp1[2] * focal], axis=-1)
    horizon = np.stack([np.cos(tilt), np.sin(tilt), np.zeros_like(tilt)], axis=-1)
    # The road's normal is orthogonal to both directions; across is orthogonal to it and to the way.
    normal = np.cross(ray, horizon)
    side = np.cross(normal, ray)
    return tuple(np.concatenate([d[..., :2] * focal[..., None], d[..., 2:]], axis=-1) for d in (side, normal))  # type: ignore[return-value]


def find_across(
    edges: Edges, vp1: Array, width: float, *, road: Array, temper: float = 1.0, around: Across | None = None
) -> Across:
    """Tilt and focal length: the mean of what is probable near the most probable pair.

    Args:
        edges: of moving vehicles.
        vp1: (3,) homogeneous, normalised.
        width: of the picture, units.
        road: (M, 2) places on the road, normalised: nearly all of them lie below the horizon.
        temper: by how much the edges' joint evidence is discounted: those of one vehicle are not independent.
        around: look only near this answer, with few edges: for resamples.
    """
    kept = _angles(edges, vp1) > np.radians(_ALONG_DEG) + 2 * edges.deviation
    edges = edges[kept]
    coarse = np.arange(len(edges))[:: max(1, len(edges) // _COARSE)]
    low, high = _tilt_range(vp1)
    tilts, focals = np.linspace(low, high, 49), width * np.geomspace(*_FOCAL_LIMITS, 40)
    rounds = 4
    if around is not None:
        tilts = around.tilt + np.linspace(-1, 1, 21) * max(4 * around.tilt_sd, np.radians(0.5))
        focals = around.focal * np.exp(np.linspace(-1, 1, 21) * max(4 * around.focal_sd, 0.1))
        rounds = 1
    best = None
    for _ in range(rounds):
        grid_tilt, grid_focal = np.meshgrid(tilts, focals, indexing="ij")
        chosen = edges[coarse] if best is None else edges
        score = _log_prior(grid_tilt, grid_focal / width)
        score += np.where(_above_all(vp1, grid_tilt, road), 0.0, -np.inf)
        score += temper * len(edges) / max(len(chosen), 1) * _log_likelihood(chosen, vp1, grid_tilt, grid_focal)
        if not np.isfinite(score).any():
            break
        density = np.exp(score - score.max())
        density /= density.sum()
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        best = (float(tilts[row]), float(focals[column]))
        mean, spread = _moments(density, tilts, np.log(focals))
        tilt_reach = max(3.5 * spread[0], 2 * (tilts[1] - tilts[0]) if len(tilts) > 21 else 0)
        focal_reach = max(3.5 * spread[1], 2 * float(np.log(focals[1] / focals[0])) if len(focals) > 21 else 0)
        tilts = best[0] + np.linspace(-tilt_reach, tilt_reach, 21)
        focals = best[1] * np.exp(np.linspace(-focal_reach, focal_reach, 21))
    if best is None:
        return around or Across(0.0, _FOCAL_MEDIAN * width, _TILT_SD, _FOCAL_SD, 0.0, 0.0)
    near = _angles(edges, directions(vp1, np.array(mean[0]), np.array(mean[1]))[0]) < np.radians(1.5)
    chance = 1.5 / 90
    support_share = float(near.mean()) - chance if len(edges) else 0.0
    return Across(*mean, *spread, support_share * len(edges), support_share)


def _log_prior(tilt: Array, focal_widths: Array) -> Array:
    inside = (np.abs(tilt) <= _TILT_LIMIT) & (focal_widths >= _FOCAL_LIMITS[0]) & (focal_widths <= _FOCAL_LIMITS[1])
    usual = -0.5 * ((tilt / _TILT_SD) ** 2 + (np.log(focal_widths / _FOCAL_MEDIAN) / _FOCAL_SD) ** 2)
    return np.where(inside, usual, -np.inf)


def _tilt_range(vp1: Array) -> tuple[float, float]:
    """Tilts that people leave a camera with and that let it see the horizon neither far above nor below the middle."""
    low, high = -_TILT_LIMIT, _TILT_LIMIT
    if abs(vp1[0]) > abs(vp1[2]):
        ends = sorted(float(np.arctan((vp1[1] - offset * vp1[2]) / vp1[0])) for offset in _HORIZON_OFFSETS)
        if ends[0] < high and ends[1] > low:
            low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def _above_all(vp1: Array, tilt: Array, road: Array) -> NDArray[np.bool_]:
    """(tilt.shape) whether the horizon through VP1 leaves nearly all places of the road below it."""
    down = np.stack([-np.sin(tilt), np.cos(tilt)], axis=-1)
    depth = (road @ np.moveaxis(down, -1, 0).reshape(2, -1)) * vp1[2] - (down.reshape(-1, 2) @ vp1[:2])
    return np.asarray(((depth * (np.sign(vp1[2]) or 1.0)) > 0).mean(axis=0) > 0.95).reshape(tilt.shape)


def _log_likelihood(edges: Edges, vp1: Array, tilt: Array, focal: Array) -> Array:
    """(tilt.shape) how probable the edges' directions are."""
    vp2, vp3 = (d.reshape(-1, 3) for d in directions(vp1, tilt, focal))
    total = np.zeros(len(vp2))
    deviation = edges.deviation.astype(np.float32)
    seen = _Seen(edges, 1 / edges.deviation)
    step = max(1, _AT_ONCE // max(len(edges), 1))
    for start in range(0, len(vp2), step):
        part = np.s_[start : start + step]
        density = np.full((len(vp2[part]), len(edges)), _SHARES[2] * 2 / np.pi, dtype=np.float32)
        for vp, share in ((vp2[part], _SHARES[0]), (vp3[part], _SHARES[1])):
            off, away = seen.from_points(vp)
            off *= off
            off += away
            # A peak as wide as the deviation, of the angle whose squared sine is off / away.
            away *= np.float32(share * 2 / np.pi) / deviation
            away /= off
            density += away
        total[part] = np.log(density, out=density).sum(axis=1, dtype=np.float64)
    return total.reshape(tilt.shape)


class _Seen:
    """N edges as matrices, so that what M points are to them takes two products.

    Args:
        edges: N of them.
        weight: (N,) factors of how far points lie off the edges.
    """

    def __init__(self, edges: Edges, weight: Array | float = 1.0) -> None:
        (mx, my), (dx, dy) = edges.middle.T, edges.direction.T
        self._lines = (np.stack([-dy, dx, dy * mx - dx * my]) * weight).astype(np.float32)
        self._places = np.stack([np.ones_like(mx), mx, my, mx**2 + my**2]).astype(np.float32)

    def from_points(self, vp: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """For homogeneous points (M, 3) how far they are off the edges' lines, weighted, and their squared distance
        from the edges, both (M, N) and times the points' third coordinate."""
        x, y, w = vp.T
        bent = np.stack([x**2 + y**2, -2 * x * w, -2 * y * w, w**2], axis=1)
        return vp.astype(np.float32) @ self._lines, bent.astype(np.float32) @ self._places


def _angles(edges: Edges, vp: Array) -> Array:
    """(N,) angle in the picture, 0 to pi / 2, between edges and the direction to a point (3,)."""
    off, away = (part[0].astype(np.float64) for part in _Seen(edges).from_points(vp[None]))
    return np.asarray(np.arcsin(np.minimum(np.abs(off) / np.sqrt(away), 1.0)))


def _moments(density: Array, tilts: Array, log_focals: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Tilt and focal length, the means of tilt and of the focal length's logarithm; and their spreads."""
    over_tilt, over_focal = density.sum(axis=1), density.sum(axis=0)
    tilt, focal = float(over_tilt @ tilts), float(over_focal @ log_focals)
    spread = (float(np.sqrt(over_tilt @ (tilts - tilt) ** 2)), float(np.sqrt(over_focal @ (log_focals - focal) ** 2)))
    return (tilt, float(np.exp(focal))), (max(spread[0], 1e-4), max(spread[1], 1e-3))
