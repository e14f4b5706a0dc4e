"""From what was observed to the camera's orientation and focal length, with what they rest on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.calibration.confidence import Evidence, check_across, check_camera, check_travel
from labelgen.calibration.observation.collect import Observations
from labelgen.calibration.vanishing.curvature import bend_deg
from labelgen.calibration.vanishing.vp1 import (
    TrackLines,
    Travel,
    find_travel,
    group_vehicles,
    outer_tracks,
    refine_travel,
    track_lines,
)
from labelgen.calibration.vanishing.vp2 import Across, Edges, directions, edges_of, find_across
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["Basis", "Orientation", "estimate_orientation", "road_camera"]

# Half a usual field of view: with it, normalised angles are nearly angles at the camera.
_UNIT_WIDTHS = 1.2
_SHORTEST_SHARE = 0.04
_LONGEST_SCATTER = 0.03
_LEAST_DEPTH = 0.03
# So many tracks at the sides of vehicles make those in their middle superfluous, which err together.
_FEWEST_OUTER, _INNER_WORTH = 40, 0.02
_RESAMPLES = 12
_BLOCK_S = 3.0
_RESAMPLED_EDGES = 2500
# Edges of one vehicle are seen again and again; so many of them are worth as much as independent ones would be.
_EDGES_PER_VEHICLE = 20
# A vanishing point farther away than this, px, is brought this near by turning the camera by less than it is known.
_FARTHEST_PX = 1e7


@dataclass(frozen=True, eq=False)
class Basis:
    """What an orientation was estimated from, in normalised coordinates.

    Args:
        unit: px per unit.
        width: of the picture, units.
        tracks: (N,) numbers of the tracks used, in the observations' list.
        vehicles: (N,) number of each track's vehicle.
        road: (M, 2) places on the road.
        edges: of vehicles.
        temper: by how much the edges' joint evidence is discounted.
        across: what they say.
    """

    unit: float
    width: float
    tracks: NDArray[np.int64]
    vehicles: NDArray[np.int64]
    road: Array
    edges: Edges
    temper: float
    across: Across


@dataclass(frozen=True, eq=False)
class Orientation:
    """The camera without its scale.

    Args:
        camera: scale None.
        evidence: what it rests on.
        supporting: numbers of the tracks that VP1 rests on, in the observations' list.
        basis: what it was estimated from.
    """

    camera: Camera
    evidence: Evidence
    supporting: NDArray[np.int64]
    basis: Basis


def estimate_orientation(
    name: str, seen: Observations, pp: ArrayLike | None = None, *, resamples: int = _RESAMPLES
) -> Orientation:
    """VP1, VP2 and the focal length.

    Args:
        name: of the video, for messages.
        seen: what the pass over it gave.
        pp: (2,) px, principal point; the picture's middle when None.
        resamples: how often the traffic is resampled for the spreads.

    Raises:
        CalibrationRefusedError: the video cannot carry it; says why.
    """
    width, height = seen.size_wh
    centre = np.array([width / 2, height / 2]) if pp is None else np.asarray(pp, dtype=np.float64)
    unit = _UNIT_WIDTHS * max(width, height)
    numbers, lines = _usable_lines(seen, centre, unit)
    check_camera(name, seen, len(lines), len(lines))
    first = find_travel(lines)
    horizon = _horizon_px(first.direction, centre, unit)
    vehicles = group_vehicles([seen.tracks[k] for k in numbers], horizon, _LEAST_DEPTH * unit)
    weights: Array = np.bincount(vehicles)[vehicles].astype(np.float64) ** -0.5
    count = _weighty(vehicles, lines)
    check_camera(name, seen, len(lines), count)
    outer = outer_tracks(lines, first.direction, vehicles)
    if np.count_nonzero(outer) >= _FEWEST_OUTER:
        weights = weights * np.where(outer, 1.0, _INNER_WORTH)
    travel = refine_travel(lines, first.direction, vehicles, weights)
    importance = weights * lines.length
    along_share = float(np.average(travel.explained, weights=importance))
    bend = bend_deg(lines, travel, weights)
    check_travel(name, along_share, bend)

    edges = edges_of(seen.edgelets, centre, unit)
    road = lines.centre[travel.explained]
    temper = min(1.0, _EDGES_PER_VEHICLE * count / max(len(edges), 1))
    across = find_across(edges, travel.direction, width / unit, road=road, temper=temper)
    check_across(name, across.support, across.support_share, float(np.degrees(across.tilt_sd)))
    camera = road_camera(travel.direction, across.tilt, across.focal, centre, unit, seen.size_wh)
    spread = _Resampler(seen, lines, vehicles, weights, edges, road, width / unit).spread(
        travel, across, temper, resamples
    )
    evidence = Evidence(
        vehicles=count,
        tracks=len(lines),
        edges=len(edges),
        along_share=along_share,
        bend_deg=bend,
        across_edges=across.support,
        across_share=across.support_share,
        vp1_deg=spread[0],
        tilt_deg=float(np.degrees(np.hypot(spread[1], across.tilt_sd))),
        focal=float(np.hypot(spread[2], across.focal_sd)),
        drift=seen.drift,
        seconds=seen.duration_s,
    )
    basis = Basis(unit, width / unit, numbers, vehicles, road, edges, temper, across)
    return Orientation(camera, evidence, numbers[travel.explained], basis)


def road_camera(vp1: Array, tilt: float, focal: float, pp: Array, unit: float, size_wh: tuple[int, int]) -> Camera:
    """The camera of a normalised VP1 (3,), a tilt and a focal length in units."""
    v = vp1 * (np.sign(vp1[2]) or 1.0)
    v = v / max(float(v[2]), unit / _FARTHEST_PX * float(np.linalg.norm(v[:2])), 1e-12)
    horizon = np.array([np.cos(tilt), np.sin(tilt)])
    # Seen straight ahead VP1 has VP2 at infinity, which two numbers cannot tell.
    least = (focal**2 + float(v[:2] @ v[:2])) * unit / _FARTHEST_PX
    beside = float(v[:2] @ horizon)
    if abs(beside) < least:
        v[:2] += horizon * (least * (np.sign(beside) or 1.0) - beside)
    across, _ = directions(np.array([*v[:2], 1.0]), np.array(tilt), np.array(focal))
    return Camera(pp + unit * v[:2], pp + unit * across[:2] / across[2], pp, image_wh=size_wh)


def _usable_lines(seen: Observations, pp: Array, unit: float) -> tuple[NDArray[np.int64], TrackLines]:
    """Tracks long and straight enough to be lines, by number."""
    lines = track_lines(seen.tracks, pp, unit)
    kept = (lines.length > _SHORTEST_SHARE) & (lines.scatter < _LONGEST_SCATTER * lines.length + 2 * lines.pixel)
    return np.flatnonzero(kept), lines[kept]


def _horizon_px(vp1: Array, pp: Array, unit: float) -> float:
    """y of the horizon where VP1 is; far above the picture where that is at infinity."""
    return float(pp[1] + unit * np.clip(vp1[1] / vp1[2] if abs(vp1[2]) > 1e-3 else -np.inf, -5.0, 5.0))


def _weighty(vehicles: NDArray[np.int64], lines: TrackLines) -> int:
    """How many of the groups are more than a stray feature."""
    several = np.bincount(vehicles) > 1
    way = np.zeros(len(several))
    np.maximum.at(way, vehicles, lines.length)
    return int(np.count_nonzero(several & (way > 2 * _SHORTEST_SHARE)))


class _Resampler:
    """The same estimate from resampled stretches of time."""

    def __init__(
        self,
        seen: Observations,
        lines: TrackLines,
        vehicles: NDArray[np.int64],
        weights: Array,
        edges: Edges,
        road: Array,
        width: float,
    ) -> None:
        self._lines, self._vehicles, self._weights, self._road, self._width = lines, vehicles, weights, road, width
        thin = np.arange(len(edges))[:: max(1, len(edges) // _RESAMPLED_EDGES)]
        self._edges = edges[thin]
        self._share = len(edges) / max(len(thin), 1)
        self._edge_blocks = (seen.edgelets[thin, 4] / _BLOCK_S).astype(np.int64)
        self._track_blocks = (lines.time_s / _BLOCK_S).astype(np.int64)

    def spread(self, travel: Travel, across: Across, temper: float, resamples: int) -> tuple[float, float, float]:
        """Standard deviations of VP1's direction (degrees), of the tilt (rad), and of the focal length (a share)."""
        rng = np.random.default_rng(0)
        blocks = np.unique(np.concatenate([self._edge_blocks, self._track_blocks]))
        found = []
        for _ in range(resamples):
            drawn = np.bincount(rng.integers(0, len(blocks), len(blocks)), minlength=len(blocks))
            times = drawn[np.searchsorted(blocks, self._track_blocks)]
            if np.count_nonzero(times) < 4:
                continue
            kept = times > 0
            again = refine_travel(
                self._lines[kept], travel.direction, self._vehicles[kept], (self._weights * times)[kept]
            )
            edges = self._edges[
                np.repeat(np.arange(len(self._edges)), drawn[np.searchsorted(blocks, self._edge_blocks)])
            ]
            other = find_across(
                edges, again.direction, self._width, road=self._road, temper=temper * self._share, around=across
            )
            found.append((*self._at_camera(again.direction, across.focal), other.tilt, np.log(other.focal)))
        if len(found) < 3:
            return 5.0, across.tilt_sd, across.focal_sd
        table = np.array(found)
        here = self._at_camera(travel.direction, across.focal)
        apart = np.degrees(np.arccos(np.clip(np.abs(table[:, :3] @ here), 0, 1)))
        return float(np.sqrt((apart**2).mean())), float(table[:, 3].std()), float(table[:, 4].std())

    @staticmethod
    def _at_camera(vp1: Array, focal: float) -> Array:
        ray = vp1 * np.array([1.0, 1.0, focal])
        return np.asarray(ray / np.linalg.norm(ray))
