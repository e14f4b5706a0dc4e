"""Spreads of VP1, tilt and focal length over resampled traffic: a block bootstrap over stretches of time.

Source: Künsch, "The jackknife and the bootstrap for general stationary observations", Annals of Statistics 1989.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.vanishing.track_lines import TrackLines
from labelgen.calibration.vanishing.vp1 import Vp1Estimate, Vp1Settings, refine_vp1
from labelgen.calibration.vanishing.vp2 import NormalizedEdges, Vp2Estimate, Vp2Settings, estimate_vp2
from labelgen.geometry.homography import Array

__all__ = ["EdgeSample", "OrientationSpread", "ResamplingSettings", "TrackSample", "resampled_spread"]


@dataclass(frozen=True)
class ResamplingSettings:
    """How the traffic is resampled."""

    resamples: int = 12
    """Resamples drawn; more cost time and steady the spreads."""
    block_s: float = 3.0
    """Length of the stretches that are drawn, seconds; a vehicle should lie in about one."""
    max_edges: int = 2500
    """About how many edges a resample uses; more cost time."""
    min_tracks: int = 4
    """A resample of fewer tracks gives no VP1."""
    min_resamples: int = 3
    """With fewer resamples left, the posterior alone gives the spreads of tilt and focal length."""
    unknown_vp1_deg: float = 5.0
    """Stated spread of VP1 where none can be measured, degrees."""


@dataclass(frozen=True)
class OrientationSpread:
    """Standard deviations over resamples.

    Args:
        vp1_deg: of VP1's direction at the camera, degrees.
        tilt: of the horizon's tilt, rad.
        log_focal: of the focal length's logarithm.
    """

    vp1_deg: float
    tilt: float
    log_focal: float


@dataclass(frozen=True, eq=False)
class TrackSample:
    """N tracks and the estimate from all of them.

    Args:
        lines: the tracks.
        vehicles, weights: (N,) number of each track's vehicle, and its importance.
        vp1: from all tracks; the resamples start there.
        settings: of the estimate.
    """

    lines: TrackLines
    vehicles: NDArray[np.int64]
    weights: Array
    vp1: Vp1Estimate
    settings: Vp1Settings


@dataclass(frozen=True, eq=False)
class EdgeSample:
    """M edges and the estimate from all of them.

    Args:
        edges: of vehicles.
        times_s: (M,) seconds.
        road, width, likelihood_power: see `estimate_vp2`.
        vp2: from all edges; the resamples are searched near it.
        settings: of the estimate.
    """

    edges: NormalizedEdges
    times_s: Array
    road: Array
    width: float
    likelihood_power: float
    vp2: Vp2Estimate
    settings: Vp2Settings


def resampled_spread(tracks: TrackSample, edges: EdgeSample, settings: ResamplingSettings) -> OrientationSpread:
    """Repeat the estimates on resampled stretches of time and return their spreads.

    Args:
        tracks, edges: from the same pass over a video.
        settings: of the resampling.
    """
    lines, focal = tracks.lines, edges.vp2.focal
    thin = np.arange(len(edges.edges))[:: max(1, len(edges.edges) // settings.max_edges)]
    thin_edges = edges.edges[thin]
    power = edges.likelihood_power * (len(edges.edges) / max(len(thin), 1))
    edge_blocks = (edges.times_s[thin] / settings.block_s).astype(np.int64)
    track_blocks = (lines.time_s / settings.block_s).astype(np.int64)
    blocks = np.unique(np.concatenate([edge_blocks, track_blocks]))
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(settings.resamples):
        drawn = np.bincount(rng.integers(0, len(blocks), len(blocks)), minlength=len(blocks))
        times = drawn[np.searchsorted(blocks, track_blocks)]
        if np.count_nonzero(times) < settings.min_tracks:
            continue
        used = times > 0
        weights = (tracks.weights * times)[used]
        vp1 = refine_vp1(lines[used], tracks.vp1.direction, tracks.vehicles[used], weights, tracks.settings)
        repeated = np.repeat(np.arange(len(thin_edges)), drawn[np.searchsorted(blocks, edge_blocks)])
        vp2 = estimate_vp2(
            thin_edges[repeated],
            vp1.direction,
            edges.width,
            road=edges.road,
            likelihood_power=power,
            around=edges.vp2,
            settings=edges.settings,
        )
        rows.append((*_ray(vp1.direction, focal), vp2.tilt, np.log(vp2.focal)))
    if len(rows) < settings.min_resamples:
        return OrientationSpread(settings.unknown_vp1_deg, edges.vp2.tilt_sd, edges.vp2.focal_sd)
    table = np.array(rows)
    angles = np.degrees(np.arccos(np.clip(np.abs(table[:, :3] @ _ray(tracks.vp1.direction, focal)), 0, 1)))
    return OrientationSpread(float(np.sqrt((angles**2).mean())), float(table[:, 3].std()), float(table[:, 4].std()))


def _ray(vp1: Array, focal: float) -> Array:
    """Return the unit ray (3,) at the camera of a homogeneous, normalised VP1 (3,)."""
    ray = vp1 * np.array([1.0, 1.0, focal])
    return np.asarray(ray / np.linalg.norm(ray))
