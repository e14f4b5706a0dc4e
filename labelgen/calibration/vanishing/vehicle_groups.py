"""Which tracks are of one vehicle, and which of them are at its sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.vanishing.track_lines import TrackLines
from labelgen.calibration.vanishing.vp1 import horizon_tangent
from labelgen.geometry.homography import Array, homogeneous

__all__ = ["VehicleGroupSettings", "group_vehicles", "outer_tracks"]


@dataclass(frozen=True)
class VehicleGroupSettings:
    """How tracks are grouped into vehicles."""

    samples: int = 16
    """Points, evenly in time, at which a track is resampled to compare it with others."""
    max_distance: float = 0.15
    """Largest distance between features of one vehicle as a share of their depth below the horizon, that is of the
    camera's height on the road; larger values join vehicles, smaller ones part them."""
    rigid_share: float = 0.2
    """Largest change of this distance, as a share of it."""
    rigid_offset: float = 0.02
    """Added to that change, in the same measure as the distance: the noise of the features."""
    min_depth: float = 0.03
    """Depth below the horizon, in units, under which vehicles are too small to tell apart."""
    min_features: int = 4
    """A vehicle of fewer features has no sides."""
    side_share: float = 0.15
    """Share of a vehicle's features, at either side, that count as its sides. Features between them are often
    reflections, which slide over the body; a smaller share leaves fewer tracks for VP1."""


def group_vehicles(
    tracks: Sequence[Track], horizon_px: float, min_depth_px: float, settings: VehicleGroupSettings | None = None
) -> NDArray[np.int64]:
    """Return the number (N,) of each track's vehicle: features that keep their distance are on one vehicle.

    Args:
        tracks: N tracks.
        horizon_px: y of the horizon; far from the frame where VP1 is.
        min_depth_px: depth below the horizon under which vehicles are too small to tell apart.
        settings: thresholds.
    """
    settings = settings or VehicleGroupSettings()
    starts, ends = (np.array([track.times_s[k] for track in tracks]) for k in (0, -1))
    paths = np.array([_resample_by_time(track, settings.samples) for track in tracks]).reshape(-1, settings.samples, 2)
    parent = np.arange(len(tracks))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    alive = np.empty(0, dtype=np.int64)
    for i in np.argsort(starts, kind="stable").tolist():
        alive = alive[ends[alive] > starts[i]]
        last = np.minimum(ends[alive], ends[i])
        first = np.full(len(alive), starts[i])
        own = np.full(len(alive), i)
        offsets = []
        for moment in (first, last):
            mine, theirs = (_positions_at(paths, starts, ends, rows, moment) for rows in (own, alive))
            # What drives along the road grows with its depth below the horizon: in that measure it is rigid.
            offsets.append((theirs - mine) / np.maximum(np.abs(mine[:, 1:] - horizon_px), min_depth_px))
        distance = np.maximum(*(np.hypot(*d.T) for d in offsets))
        change = np.hypot(*(offsets[1] - offsets[0]).T)
        together = distance < settings.max_distance
        together &= change < settings.rigid_share * distance + settings.rigid_offset
        for j in alive[together].tolist():
            parent[root(i)] = root(j)
        alive = np.append(alive, i)
    roots = np.array([root(i) for i in range(len(tracks))], dtype=np.int64)
    return np.unique(roots, return_inverse=True)[1]


def outer_tracks(
    lines: TrackLines, vp1: Array, vehicles: NDArray[np.int64], settings: VehicleGroupSettings | None = None
) -> NDArray[np.bool_]:
    """Return which tracks (N,) are at the sides of their vehicles, seen along the road.

    Corners of bodies, tyres and lamps keep their places on the vehicle. Reflections on the bonnet and the windscreen,
    and the outlines of round forms, slide over it, which makes vehicles look as if they drove to a point below the
    horizon.

    Args:
        lines: N tracks.
        vp1: (3,) homogeneous, normalised, rough.
        vehicles: (N,) number of each track's vehicle, 0 to V - 1.
        settings: thresholds.
    """
    settings = settings or VehicleGroupSettings()
    v = vp1 / np.linalg.norm(vp1)
    tangent = horizon_tangent(v)
    normals = np.cross(homogeneous(lines.centre), v)
    angle = np.arctan2(normals @ tangent, normals @ np.cross(v, tangent))
    _, first, counts = np.unique(vehicles, return_index=True, return_counts=True)
    # Relative to the vehicle's first track, so that no vehicle lies across the jump from -pi to pi.
    angle = (angle - angle[first][vehicles] + np.pi) % (2 * np.pi) - np.pi
    order = np.lexsort((angle, vehicles))
    rank = np.empty(len(lines))
    rank[order] = np.arange(len(lines)) - np.repeat(np.cumsum(counts) - counts, counts)
    count = counts[vehicles]
    share = rank / np.maximum(count - 1, 1)
    return np.asarray((count >= settings.min_features) & (np.minimum(share, 1 - share) <= settings.side_share))


def _resample_by_time(track: Track, samples: int) -> Array:
    """Return points (samples, 2) of a track at even times."""
    at = np.linspace(track.times_s[0], track.times_s[-1], samples)
    return np.stack([np.interp(at, track.times_s, track.points_px[:, axis]) for axis in (0, 1)], axis=1)


def _positions_at(paths: Array, starts: Array, ends: Array, rows: NDArray[np.int64], times_s: Array) -> Array:
    """Return the positions (M, 2) of tracks (M,) at one moment each (M,), seconds.

    Args:
        paths: (N, K, 2) px, points of all tracks at even times.
        starts, ends: (N,) seconds.
        rows: (M,) numbers of the tracks.
        times_s: (M,).
    """
    samples = paths.shape[1]
    place = (times_s - starts[rows]) / (ends[rows] - starts[rows]) * (samples - 1)
    low = np.clip(place.astype(np.int64), 0, samples - 2)
    share = (place - low)[:, None]
    return np.asarray(paths[rows, low] * (1 - share) + paths[rows, low + 1] * share)
