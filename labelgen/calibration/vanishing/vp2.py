"""VP2, the vanishing point across the road, and the focal length, from edges on vehicles when VP1 is known.

VP1 leaves two unknowns: the tilt of the horizon, on which VP1 and VP2 lie, and the focal length, which fixes how far
apart they are because they are orthogonal. Every pair of the two gives VP2 and VP3. Edges of vehicles run along, across
and up, or somewhere else. The likelihood of all edges together is computed on a grid of pairs. VP2 may lie at infinity:
then the edges determine the tilt alone, and the prior decides on the focal length, which the spread reports.

Convention: normalised coordinates, as in `track_lines`. The tilt is the angle of the horizon in the image, rad,
positive when it falls to the right. A focal length is in units.

Source: Dubska et al., BMVC 2014 (the constraint, diamond space); Sochor et al., CVIU 2017 (edges of vehicles). The
joint likelihood over tilt and focal length is this project's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = [
    "NormalizedEdges",
    "Vp2Estimate",
    "Vp2Settings",
    "estimate_vp2",
    "normalize_edgelets",
    "orthogonal_vanishing_points",
]


@dataclass(frozen=True)
class Vp2Settings:
    """How tilt and focal length are estimated."""

    tilt_sd_deg: float = 3.0
    """Standard deviation of the prior on the horizon's tilt, degrees: cameras are set up nearly level."""
    max_tilt_deg: float = 12.0
    """Largest tilt considered, degrees."""
    focal_median_widths: float = 1.2
    """Median of the prior on the focal length, in widths of the frame."""
    focal_log_sd: float = 0.55
    """Standard deviation of its natural logarithm; larger values let few edges decide."""
    min_focal_widths: float = 0.4
    """Shortest focal length considered, in widths of the frame."""
    max_focal_widths: float = 5.0
    """Longest focal length considered, in widths of the frame."""
    edge_sd_deg: float = 0.5
    """Standard deviation of the edges' own directions, degrees: vehicles are not boxes."""
    end_point_px: float = 0.6
    """Standard deviation of an edge's end points, px."""
    share_vp2: float = 0.35
    """Share of the edges that point to VP2."""
    share_vp3: float = 0.1
    """Share of the edges that point to VP3."""
    share_other: float = 0.55
    """Share of the edges of any direction."""
    along_deg: float = 5.0
    """Edges within this angle of VP1, degrees, beside their own deviation, say nothing about VP2 and are left out."""
    min_horizon_offset: float = -3.0
    """Highest horizon considered, units below the principal point: cameras look down, but not straight down."""
    max_horizon_offset: float = 0.4
    """Lowest horizon considered, units below the principal point: most of the image shows road."""
    road_below_share: float = 0.95
    """Least share of the places on the road that must lie below the horizon."""
    coarse_edges: int = 4000
    """About how many edges the first, coarse grid uses; more cost time."""
    tilt_steps: int = 49
    """Tilts of the coarse grid."""
    focal_steps: int = 40
    """Focal lengths of the coarse grid."""
    fine_steps: int = 21
    """Tilts and focal lengths of each finer grid."""
    rounds: int = 4
    """Grids, each finer than the one before."""
    reach_sd: float = 3.5
    """Half the extent of a finer grid, in standard deviations of the posterior."""
    local_reach_sd: float = 4.0
    """The same for the one grid around a known answer."""
    min_local_tilt_deg: float = 0.5
    """Least half extent of that grid in the tilt, degrees."""
    min_local_log_focal: float = 0.1
    """Least half extent of that grid in the focal length's logarithm."""
    support_deg: float = 1.5
    """An edge within this angle of VP2, degrees, supports it."""
    chunk_values: int = 60_000
    """Numbers per chunk of the likelihood: they fit into the processor's cache together with what is computed from
    them, and the matrix library uses one thread for products of this size."""


@dataclass(frozen=True, eq=False)
class NormalizedEdges:
    """N edges in normalised coordinates.

    Args:
        middle: (N, 2).
        direction: (N, 2) unit vectors.
        deviation: (N,) standard deviation of the direction, rad.
        length: (N,).
    """

    middle: Array
    direction: Array
    deviation: Array
    length: Array

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> NormalizedEdges:
        return NormalizedEdges(self.middle[rows], self.direction[rows], self.deviation[rows], self.length[rows])


@dataclass(frozen=True, eq=False)
class Vp2Estimate:
    """Tilt and focal length.

    Args:
        tilt: rad.
        focal: units.
        tilt_sd, focal_sd: standard deviations of the posterior, rad and of the natural logarithm.
        support: edges that point to VP2, in excess of as many as chance would give.
        support_share: the same as a share of all edges not along the road.
    """

    tilt: float
    focal: float
    tilt_sd: float
    focal_sd: float
    support: float
    support_share: float


def normalize_edgelets(edgelets: Array, pp: Array, unit: float, settings: Vp2Settings | None = None) -> NormalizedEdges:
    """Return edges in normalised coordinates.

    Args:
        edgelets: (N, >= 4) end points x0, y0, x1, y1 in px.
        pp: (2,) px, principal point.
        unit: px per normalised unit.
        settings: thresholds.
    """
    settings = settings or Vp2Settings()
    ends = (edgelets[:, :4].reshape(-1, 2, 2) - pp) / unit
    vectors = ends[:, 1] - ends[:, 0]
    length = np.maximum(np.hypot(*vectors.T), 1e-9)
    deviation = np.hypot(np.radians(settings.edge_sd_deg), settings.end_point_px / unit / length)
    return NormalizedEdges(ends.mean(axis=1), vectors / length[:, None], deviation, length)


def orthogonal_vanishing_points(vp1: Array, tilt: Array, focal: Array) -> tuple[Array, Array]:
    """Return VP2 and VP3, homogeneous (..., 3), for VP1 (3,) and arrays (...) of tilts and focal lengths.

    All in normalised coordinates; VP2 lies on the horizon through VP1 at that tilt, orthogonal to it.
    """
    tilt, focal = np.broadcast_arrays(tilt, focal)
    ray = np.stack([vp1[0] + 0 * focal, vp1[1] + 0 * focal, vp1[2] * focal], axis=-1)
    horizon = np.stack([np.cos(tilt), np.sin(tilt), np.zeros_like(tilt)], axis=-1)
    # The road's normal is orthogonal to VP1 and the horizon; VP2 is orthogonal to the normal and to VP1.
    normal = np.cross(ray, horizon)
    across = np.cross(normal, ray)
    vp2, vp3 = (np.concatenate([d[..., :2] * focal[..., None], d[..., 2:]], axis=-1) for d in (across, normal))
    return vp2, vp3


def estimate_vp2(
    edges: NormalizedEdges,
    vp1: Array,
    width: float,
    *,
    road: Array,
    likelihood_power: float = 1.0,
    around: Vp2Estimate | None = None,
    settings: Vp2Settings | None = None,
) -> Vp2Estimate:
    """Estimate tilt and focal length: the posterior's mean near its maximum.

    Args:
        edges: of moving vehicles.
        vp1: (3,) homogeneous, normalised.
        width: of the frame, units.
        road: (M, 2) places on the road, normalised: nearly all of them lie below the horizon.
        likelihood_power: factor on the edges' log-likelihood, below 1 because edges of one vehicle are dependent.
        around: search near this answer only, which takes few edges and little time: for resamples.
        settings: thresholds.
    """
    settings = settings or Vp2Settings()
    edges = edges[_angles(edges, vp1) > np.radians(settings.along_deg) + 2 * edges.deviation]
    coarse = np.arange(len(edges))[:: max(1, len(edges) // settings.coarse_edges)]
    fine = settings.fine_steps
    tilts, focals = _first_grid(vp1, width, around, settings)
    best = None
    for _ in range(settings.rounds if around is None else 1):
        grid_tilt, grid_focal = np.meshgrid(tilts, focals, indexing="ij")
        used = edges[coarse] if best is None else edges
        score = _log_prior(grid_tilt, grid_focal / width, settings)
        score += np.where(_road_below_horizon(vp1, grid_tilt, road, settings.road_below_share), 0.0, -np.inf)
        log_likelihood = _log_likelihood(used, vp1, grid_tilt, grid_focal, settings)
        score += likelihood_power * len(edges) / max(len(used), 1) * log_likelihood
        if not np.isfinite(score).any():
            break
        density = np.exp(score - score.max())
        density /= density.sum()
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        best = (float(tilts[row]), float(focals[column]))
        mean, spread = _moments(density, tilts, np.log(focals))
        tilt_step = 2 * (tilts[1] - tilts[0]) if len(tilts) > fine else 0
        focal_step = 2 * float(np.log(focals[1] / focals[0])) if len(focals) > fine else 0
        tilt_reach = max(settings.reach_sd * spread[0], tilt_step)
        focal_reach = max(settings.reach_sd * spread[1], focal_step)
        tilts = best[0] + np.linspace(-tilt_reach, tilt_reach, fine)
        focals = best[1] * np.exp(np.linspace(-focal_reach, focal_reach, fine))
    if best is None:
        prior_focal = settings.focal_median_widths * width
        prior_tilt_sd = float(np.radians(settings.tilt_sd_deg))
        return around or Vp2Estimate(0.0, prior_focal, prior_tilt_sd, settings.focal_log_sd, 0.0, 0.0)
    vp2, _ = orthogonal_vanishing_points(vp1, np.array(mean[0]), np.array(mean[1]))
    near = _angles(edges, vp2) < np.radians(settings.support_deg)
    chance = settings.support_deg / 90
    support_share = float(near.mean()) - chance if len(edges) else 0.0
    return Vp2Estimate(*mean, *spread, support_share * len(edges), support_share)


def _first_grid(vp1: Array, width: float, around: Vp2Estimate | None, settings: Vp2Settings) -> tuple[Array, Array]:
    """Return the tilts (T,), rad, and focal lengths (F,), units, of the coarse grid, or of the one around an answer."""
    if around is None:
        low, high = _tilt_range(vp1, settings)
        focals = np.geomspace(settings.min_focal_widths, settings.max_focal_widths, settings.focal_steps)
        return np.linspace(low, high, settings.tilt_steps), width * focals
    tilt_reach = max(settings.local_reach_sd * around.tilt_sd, np.radians(settings.min_local_tilt_deg))
    focal_reach = max(settings.local_reach_sd * around.focal_sd, settings.min_local_log_focal)
    steps = np.linspace(-1, 1, settings.fine_steps)
    return around.tilt + steps * tilt_reach, around.focal * np.exp(steps * focal_reach)


def _log_prior(tilt: Array, focal_widths: Array, settings: Vp2Settings) -> Array:
    inside = np.abs(tilt) <= np.radians(settings.max_tilt_deg)
    inside &= (focal_widths >= settings.min_focal_widths) & (focal_widths <= settings.max_focal_widths)
    tilt_z = tilt / np.radians(settings.tilt_sd_deg)
    focal_z = np.log(focal_widths / settings.focal_median_widths) / settings.focal_log_sd
    return np.where(inside, -0.5 * (tilt_z**2 + focal_z**2), -np.inf)


def _tilt_range(vp1: Array, settings: Vp2Settings) -> tuple[float, float]:
    """Return the tilts, rad, that put the horizon neither far above nor below the principal point."""
    low, high = -np.radians(settings.max_tilt_deg), np.radians(settings.max_tilt_deg)
    if abs(vp1[0]) > abs(vp1[2]):
        offsets = settings.min_horizon_offset, settings.max_horizon_offset
        ends = sorted(float(np.arctan((vp1[1] - offset * vp1[2]) / vp1[0])) for offset in offsets)
        if ends[0] < high and ends[1] > low:
            low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def _road_below_horizon(vp1: Array, tilt: Array, road: Array, min_share: float) -> NDArray[np.bool_]:
    """(tilt.shape) whether the horizon through VP1 leaves nearly all places of the road (M, 2) below it."""
    down = np.stack([-np.sin(tilt), np.cos(tilt)], axis=-1)
    depth = (road @ np.moveaxis(down, -1, 0).reshape(2, -1)) * vp1[2] - (down.reshape(-1, 2) @ vp1[:2])
    below = (depth * (np.sign(vp1[2]) or 1.0)) > 0
    return np.asarray(below.mean(axis=0) > min_share).reshape(tilt.shape)


def _log_likelihood(edges: NormalizedEdges, vp1: Array, tilt: Array, focal: Array, settings: Vp2Settings) -> Array:
    """(tilt.shape) log-likelihood of the edges' directions."""
    vp2, vp3 = (d.reshape(-1, 3) for d in orthogonal_vanishing_points(vp1, tilt, focal))
    total = np.zeros(len(vp2))
    deviation = edges.deviation.astype(np.float32)
    products = _EdgeProducts(edges, 1 / edges.deviation)
    step = max(1, settings.chunk_values // max(len(edges), 1))
    for start in range(0, len(vp2), step):
        part = np.s_[start : start + step]
        density = np.full((len(vp2[part]), len(edges)), settings.share_other * 2 / np.pi, dtype=np.float32)
        for vp, share in ((vp2[part], settings.share_vp2), (vp3[part], settings.share_vp3)):
            off, away = products.from_points(vp)
            off *= off
            off += away
            # A peak as wide as the deviation, of the angle whose squared sine is off / away.
            away *= np.float32(share * 2 / np.pi) / deviation
            away /= off
            density += away
        total[part] = np.log(density, out=density).sum(axis=1, dtype=np.float64)
    return total.reshape(tilt.shape)


class _EdgeProducts:
    """N edges as matrices, so that their relation to M points takes two matrix products.

    Args:
        edges: N of them.
        weight: (N,) factors of how far points lie off the edges.
    """

    def __init__(self, edges: NormalizedEdges, weight: Array | float = 1.0) -> None:
        (mx, my), (dx, dy) = edges.middle.T, edges.direction.T
        self._lines = (np.stack([-dy, dx, dy * mx - dx * my]) * weight).astype(np.float32)
        self._places = np.stack([np.ones_like(mx), mx, my, mx**2 + my**2]).astype(np.float32)

    def from_points(self, vp: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return distances from the edges for homogeneous points (M, 3), both (M, N).

        The first is the weighted distance from the edges' lines, times the points' third coordinate; the second the
        squared distance from the edges' middles, times its square.
        """
        x, y, w = vp.T
        squares = np.stack([x**2 + y**2, -2 * x * w, -2 * y * w, w**2], axis=1)
        return vp.astype(np.float32) @ self._lines, squares.astype(np.float32) @ self._places


def _angles(edges: NormalizedEdges, vp: Array) -> Array:
    """(N,) angle in the image, 0 to pi / 2, between edges and the direction to a point (3,)."""
    off, away = (part[0].astype(np.float64) for part in _EdgeProducts(edges).from_points(vp[None]))
    return np.asarray(np.arcsin(np.minimum(np.abs(off) / np.sqrt(away), 1.0)))


def _moments(density: Array, tilts: Array, log_focals: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the means and the standard deviations of tilt and focal length; the latter's of its logarithm."""
    over_tilt, over_focal = density.sum(axis=1), density.sum(axis=0)
    tilt, focal = float(over_tilt @ tilts), float(over_focal @ log_focals)
    spread = (float(np.sqrt(over_tilt @ (tilts - tilt) ** 2)), float(np.sqrt(over_focal @ (log_focals - focal) ** 2)))
    return (tilt, float(np.exp(focal))), (max(spread[0], 1e-4), max(spread[1], 1e-3))
