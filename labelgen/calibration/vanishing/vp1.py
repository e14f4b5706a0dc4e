"""VP1, the direction of travel: the point that the tracks of moving things have in common.

Tracks become straight lines, the lines vote in diamond space, and the peak is refined by reweighted least squares on
the sphere of directions, where infinity is a place like any other. Vehicles that come and vehicles that go share one
VP1; the ones that cross do not, and neither do those in a bend: both are measured here and judged in `confidence`.

Convention: normalised coordinates are (px - pp) / unit with a unit of about a focal length, so that angles between
normalised directions are nearly angles at the camera.

Source: Dubska et al., BMVC 2014, section 2 (tracks of features, diamond space).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.vanishing.diamond_space import accumulate, peak
from labelgen.geometry.homography import Array, homogeneous

__all__ = [
    "TrackLines",
    "Travel",
    "find_travel",
    "group_vehicles",
    "outer_tracks",
    "planes_of",
    "refine_travel",
    "sideways",
    "spread_of",
    "track_lines",
    "weighted_quantile",
]

_SAMPLES = 16
_ITERATIONS = 60
# Vehicles head off VP1 by between these angles, rad, as standard deviation; features are off by this many px.
_WANDER = (0.002, 0.01)
_NOISE_PX = 1.0
_TUKEY = 3.0
# A line's vote counts by its length up to this much, in units.
_LONG = 0.25
# Features of one vehicle are linked over gaps of this share of their depth below the horizon: of the camera's height.
_REACH = 0.15
# Features in the middle of a vehicle are reflections and highlights as often as not, which slide over it while it comes
# nearer: of a vehicle with so many features, those in this share at either side count.
_FEATURES, _OUTER_SHARE = 4, 0.15
# Within this deviation a track counts as going along the road: lanes merge, and drivers change them.
_EXPLAINED_DEG = 5.0


@dataclass(frozen=True, eq=False)
class TrackLines:
    """N tracks as straight lines, normalised.

    Args:
        centre: (N, 2).
        direction: (N, 2) unit vectors along the motion.
        length: (N,).
        scatter: (N,) robust deviation of a track's points from its line.
        halves: (N, 2, 4) centre and direction of a track's two halves, the lower one in the picture first.
        time_s: (N,) middle of each track.
        pixel: one px in normalised units.
    """

    centre: Array
    direction: Array
    length: Array
    scatter: Array
    halves: Array
    time_s: Array
    pixel: float

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> TrackLines:
        return replace(
            self,
            **{
                name: getattr(self, name)[kept]
                for name in ("centre", "direction", "length", "scatter", "halves", "time_s")
            },
        )

    @property
    def planes(self) -> Array:
        """(N, 3) unit normals of the planes through the camera and each line: the homogeneous lines."""
        return planes_of(self.centre, self.direction)


@dataclass(frozen=True, eq=False)
class Travel:
    """A direction of travel.

    Args:
        direction: (3,) unit, homogeneous VP1 in normalised coordinates.
        explained: (N,) which tracks point there.
        weights: (N,) of the tracks in the last fit.
        wander_deg: by how much the vehicles' own headings scatter.
    """

    direction: Array
    explained: NDArray[np.bool_]
    weights: Array
    wander_deg: float


def track_lines(tracks: Sequence[Track], pp: ArrayLike, unit: float) -> TrackLines:
    """Straight lines through tracks, robust against ends that leave the line.

    Args:
        tracks: N tracks.
        pp: (2,) px, principal point.
        unit: px per normalised unit.
    """
    points = np.array([_evenly(track.points_px) for track in tracks]).reshape(-1, _SAMPLES, 2)
    points = (points - np.asarray(pp, dtype=np.float64)) / unit
    centre, direction, scatter, length = _robust_lines(points, 0.25 / unit)
    forward = np.sign(((points[:, -1] - points[:, 0]) * direction).sum(axis=1))
    direction *= np.where(forward == 0, 1, forward)[:, None]
    halves = []
    for part in (points[:, : _SAMPLES // 2], points[:, _SAMPLES // 2 :]):
        middle, along, _, _ = _robust_lines(part, 0.25 / unit)
        halves.append(np.concatenate([middle, along], axis=1))
    both = np.stack(halves, axis=1)
    upside_down = both[:, 0, 1] < both[:, 1, 1]
    both[upside_down] = both[upside_down][:, ::-1]
    times = np.array([(track.times_s[0] + track.times_s[-1]) / 2 for track in tracks], dtype=np.float64)
    return TrackLines(centre, direction, length, scatter, both, times, 1 / unit)


def find_travel(lines: TrackLines, weights: ArrayLike | None = None) -> Travel:
    """The direction most tracks share, each for itself.

    Args:
        lines: N > 1 tracks.
        weights: (N,) importance of each track.
    """
    given = np.ones(len(lines)) if weights is None else np.asarray(weights, dtype=np.float64)
    start, _ = peak(accumulate(lines.planes, given * np.minimum(lines.length, _LONG)))
    return refine_travel(lines, start, np.arange(len(lines)), given)


def refine_travel(
    lines: TrackLines, start: Array, vehicles: NDArray[np.int64], weights: ArrayLike | None = None
) -> Travel:
    """Reweighted least squares from a rough direction, each vehicle with a heading of its own.

    Lanes merge and drivers wander, so that the tracks of different vehicles are not quite parallel; features of one
    vehicle are. Each vehicle's lines therefore have to meet in a point of the horizon, and these points scatter about
    VP1 along the horizon by as much as the tracks themselves tell.

    Args:
        lines: N tracks.
        start: (3,) rough direction.
        vehicles: (N,) number of each track's vehicle.
        weights: (N,) importance of each track; 1 without it.
    """
    given = np.ones(len(lines)) if weights is None else np.asarray(weights, dtype=np.float64)
    planes = lines.planes
    middle = homogeneous(lines.centre)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    v, limit, wander, used = start / np.linalg.norm(start), 6.0, _WANDER[1], given
    for _ in range(_ITERATIONS):
        side = planes @ sideways(v)
        distance = np.sqrt(np.maximum(1 - (middle @ v) ** 2, 1e-6))
        noise = (lines.scatter + _NOISE_PX * lines.pixel) * distance / lines.length
        heading = _per_vehicle(planes @ v, side, vehicles, used / noise**2, wander)
        z = (planes @ v + heading * side) / noise
        # From a rough start the scale is wide; it narrows to what the tracks themselves say.
        limit = max(_TUKEY * spread_of(z, given), limit * 0.7)
        used = given * np.maximum(1 - (z / limit) ** 2, 0) ** 2
        if np.count_nonzero(used) < 2:
            break
        wander = float(np.clip(spread_of(heading, used), *_WANDER))
        _, vectors = np.linalg.eigh(_normal_matrix(planes, side, vehicles, used / noise**2, wander))
        new = vectors[:, 0] * (np.sign(vectors[:, 0] @ v) or 1.0)
        done = np.abs(new - v).max() < 1e-9
        v = new
        if done:
            break
    allowed = np.hypot(np.radians(_EXPLAINED_DEG) * side, 3 * noise)
    return Travel(v, np.abs(planes @ v) < allowed, used, float(np.degrees(wander)))


def _per_vehicle(off: Array, side: Array, vehicles: NDArray[np.int64], weights: Array, wander: float) -> Array:
    """(N,) heading of each track's vehicle, rad to the side of VP1, held back by how little vehicles wander."""
    top = np.bincount(vehicles, weights * side * off)
    bottom = np.bincount(vehicles, weights * side**2) + wander**-2
    return np.asarray((-top / bottom)[vehicles])


def _normal_matrix(planes: Array, side: Array, vehicles: NDArray[np.int64], weights: Array, wander: float) -> Array:
    """(3, 3) normal matrix for VP1 once each vehicle's heading is eliminated."""
    along = np.stack([np.bincount(vehicles, weights * side * planes[:, k]) for k in range(3)], axis=1)
    bottom = np.bincount(vehicles, weights * side**2) + wander**-2
    return np.asarray((planes * weights[:, None]).T @ planes - (along / bottom[:, None]).T @ along)


def weighted_quantile(values: Array, weights: Array, share: float) -> float:
    """The value below which a share of the weight lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(total, share * total[-1])), len(values) - 1)]])


def sideways(v: Array) -> Array:
    """(3,) unit direction across, for a camera that does not roll much: where VP1 goes when a vehicle turns."""
    side = np.array([v[2], 0.0, -v[0]])
    length = float(np.linalg.norm(side))
    return side / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def group_vehicles(tracks: Sequence[Track], horizon_px: float, least_px: float) -> NDArray[np.int64]:
    """(N,) number of the vehicle each track belongs to: features that keep their distance are on one thing.

    Args:
        tracks: N tracks.
        horizon_px: y of the horizon; far from the picture where VP1 is.
        least_px: depth below the horizon under which vehicles are too small to tell apart.
    """
    starts, ends = (np.array([track.times_s[k] for track in tracks]) for k in (0, -1))
    paths = np.array([_timely(track) for track in tracks]).reshape(-1, _SAMPLES, 2)
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
        both = np.full(len(alive), i)
        apart = []
        for moment in (first, last):
            mine, theirs = (_at(paths, starts, ends, who, moment) for who in (both, alive))
            # What drives along the road grows with its depth below the horizon: in that measure it is rigid.
            apart.append((theirs - mine) / np.maximum(np.abs(mine[:, 1:] - horizon_px), least_px))
        size = np.maximum(*(np.hypot(*d.T) for d in apart))
        together = (size < _REACH) & (np.hypot(*(apart[1] - apart[0]).T) < 0.2 * size + 0.02)
        for j in alive[together].tolist():
            parent[root(i)] = root(j)
        alive = np.append(alive, i)
    roots = np.array([root(i) for i in range(len(tracks))], dtype=np.int64)
    return np.unique(roots, return_inverse=True)[1]


def outer_tracks(lines: TrackLines, vp1: Array, vehicles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) which tracks are at the sides of their vehicles, seen along the road: what is there does not slide.

    Corners of bodies, tyres and lamps keep their places; what the bonnet and the windscreen mirror, and the outlines of
    round forms, do not, and all of these make vehicles look as if they drove to a point below the horizon.

    Args:
        lines: N tracks.
        vp1: (3,) direction, rough.
        vehicles: (N,) number of each track's vehicle, 0 to V - 1; one with fewer than 4 tracks has no sides.
    """
    v = vp1 / np.linalg.norm(vp1)
    along = sideways(v)
    normals = np.cross(homogeneous(lines.centre), v)
    turn = np.arctan2(normals @ along, normals @ np.cross(v, along))
    _, first, counts = np.unique(vehicles, return_index=True, return_counts=True)
    # Within a vehicle, so that no turn is cut in two.
    turn = (turn - turn[first][vehicles] + np.pi) % (2 * np.pi) - np.pi
    order = np.lexsort((turn, vehicles))
    rank = np.empty(len(lines))
    rank[order] = np.arange(len(lines)) - np.repeat(np.cumsum(counts) - counts, counts)
    count = counts[vehicles]
    share = rank / np.maximum(count - 1, 1)
    return np.asarray((count >= _FEATURES) & (np.minimum(share, 1 - share) <= _OUTER_SHARE))


def _timely(track: Track) -> Array:
    """(_SAMPLES, 2) points of a track at even times."""
    at = np.linspace(track.times_s[0], track.times_s[-1], _SAMPLES)
    return np.stack([np.interp(at, track.times_s, track.points_px[:, axis]) for axis in (0, 1)], axis=1)


def _at(paths: Array, starts: Array, ends: Array, which: NDArray[np.int64], times_s: Array) -> Array:
    """(M, 2) where some tracks are at one moment each."""
    place = (times_s - starts[which]) / (ends[which] - starts[which]) * (_SAMPLES - 1)
    low = np.clip(place.astype(np.int64), 0, _SAMPLES - 2)
    share = (place - low)[:, None]
    return np.asarray(paths[which, low] * (1 - share) + paths[which, low + 1] * share)


def _evenly(points: Array) -> Array:
    """(_SAMPLES, 2) points at even distances along a track: where a feature rests does not count more."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0, way[-1], _SAMPLES)
    return np.stack([np.interp(at, way, points[:, axis]) for axis in (0, 1)], axis=1)


def _robust_lines(points: Array, least: float) -> tuple[Array, Array, Array, Array]:
    """Lines through point sets (N, K, 2) by Tukey's weights: centre, direction, scatter and length of each."""
    weights = np.ones(points.shape[:2])
    for _ in range(8):
        centre = (points * weights[..., None]).sum(axis=1) / weights.sum(axis=1, keepdims=True)
        d = points - centre[:, None]
        xx, yy, xy = ((weights * p).sum(axis=1) for p in (d[..., 0] ** 2, d[..., 1] ** 2, d[..., 0] * d[..., 1]))
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        off = d[..., 1] * direction[:, :1] - d[..., 0] * direction[:, 1:]
        scatter = 1.48 * np.median(np.abs(off), axis=1, keepdims=True) + least
        weights = np.maximum(1 - (off / (3 * scatter)) ** 2, 0) ** 2 + 1e-6
    along = (d * direction[:, None]).sum(axis=-1)
    kept = weights > 0.1
    length = np.where(kept, along, -np.inf).max(axis=1) - np.where(kept, along, np.inf).min(axis=1)
    return centre, direction, scatter[:, 0], np.maximum(length, 1e-9)


def planes_of(centre: Array, direction: Array) -> Array:
    """(N, 3) unit normals of the planes through the camera and lines (N, 2), (N, 2)."""
    normals = np.cross(homogeneous(centre), np.concatenate([direction, np.zeros((len(direction), 1))], axis=1))
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def spread_of(z: Array, weights: Array) -> float:
    """Weighted median of |z|, as a standard deviation."""
    return max(1.48 * weighted_quantile(np.abs(z), weights, 0.5), 0.05)
