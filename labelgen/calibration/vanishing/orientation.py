"""From the observations to the camera's orientation and focal length, with what they rest on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.calibration.confidence import (
    CalibrationEvidence,
    ConfidenceSettings,
    check_observations,
    check_vp1,
    check_vp2,
)
from labelgen.calibration.observation.collect import Observations
from labelgen.calibration.vanishing.curvature import CurvatureSettings, estimate_curvature_deg
from labelgen.calibration.vanishing.resampling import EdgeSample, ResamplingSettings, TrackSample, resampled_spread
from labelgen.calibration.vanishing.track_lines import TrackLines, TrackLineSettings, track_lines
from labelgen.calibration.vanishing.vehicle_groups import VehicleGroupSettings, group_vehicles, outer_tracks
from labelgen.calibration.vanishing.vp1 import Vp1Settings, estimate_vp1, refine_vp1
from labelgen.calibration.vanishing.vp2 import (
    NormalizedEdges,
    Vp2Estimate,
    Vp2Settings,
    estimate_vp2,
    normalize_edgelets,
    orthogonal_vanishing_points,
)
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["Orientation", "OrientationInputs", "OrientationSettings", "camera_from_angles", "estimate_orientation"]

_MAX_VP_PX = 1e7
"""Vanishing points farther away, px, are brought this near: it turns the camera by less than it is known."""


@dataclass(frozen=True)
class OrientationSettings:
    """How the orientation is put together from its parts."""

    unit_widths: float = 1.2
    """Normalised unit in lengths of the frame's longer side: about a usual focal length, so that normalised angles are
    nearly angles at the camera."""
    min_track_length: float = 0.04
    """Shortest track that is a line, in units; shorter ones are more, with less accurate directions."""
    max_scatter_share: float = 0.03
    """Largest scatter of a track about its line, as a share of its length; above it the track is no line."""
    scatter_px: float = 2.0
    """Added to that largest scatter, px: the noise of short tracks."""
    min_outer_tracks: int = 40
    """From so many tracks at the sides of vehicles on, those between the sides have `inner_weight`: their errors are
    alike, and more of them do not average out."""
    inner_weight: float = 0.02
    """Weight of the tracks between the sides, relative to those at the sides."""
    edges_per_vehicle: float = 20.0
    """Independent edges that all edges of one vehicle together count as: the same edge is seen in many frames."""
    lines: TrackLineSettings = field(default_factory=TrackLineSettings)
    """Of the tracks as lines."""
    groups: VehicleGroupSettings = field(default_factory=VehicleGroupSettings)
    """Of the tracks' vehicles."""
    vp1: Vp1Settings = field(default_factory=Vp1Settings)
    """Of VP1."""
    curvature: CurvatureSettings = field(default_factory=CurvatureSettings)
    """Of the road's curvature."""
    vp2: Vp2Settings = field(default_factory=Vp2Settings)
    """Of VP2 and the focal length."""
    resampling: ResamplingSettings = field(default_factory=ResamplingSettings)
    """Of the spreads."""
    confidence: ConfidenceSettings = field(default_factory=ConfidenceSettings)
    """Of what is refused."""


@dataclass(frozen=True, eq=False)
class OrientationInputs:
    """What an orientation was estimated from, in normalised coordinates.

    Args:
        unit: px per unit.
        width: of the frame, units.
        tracks: (N,) numbers of the tracks used, in the observations' list.
        vehicles: (N,) number of each track's vehicle.
        road: (M, 2) places on the road.
        edges: of vehicles.
        likelihood_power: factor on the edges' joint log-likelihood.
        vp2: the estimate from these edges.
        vp2_settings: of that estimate.
    """

    unit: float
    width: float
    tracks: NDArray[np.int64]
    vehicles: NDArray[np.int64]
    road: Array
    edges: NormalizedEdges
    likelihood_power: float
    vp2: Vp2Estimate
    vp2_settings: Vp2Settings


@dataclass(frozen=True, eq=False)
class Orientation:
    """The camera without its scale.

    Args:
        camera: scale None.
        evidence: what it rests on.
        supporting: numbers of the tracks that VP1 rests on, in the observations' list.
        inputs: what it was estimated from.
    """

    camera: Camera
    evidence: CalibrationEvidence
    supporting: NDArray[np.int64]
    inputs: OrientationInputs


def estimate_orientation(
    name: str, observations: Observations, pp: ArrayLike | None = None, settings: OrientationSettings | None = None
) -> Orientation:
    """Estimate VP1, VP2 and the focal length from tracks and edges.

    Args:
        name: of the video, for messages.
        observations: what the pass over it gave.
        pp: (2,) px, principal point; the frame's centre when None.
        settings: thresholds.

    Raises:
        CalibrationRefusedError: the video cannot carry a calibration; says why.
    """
    settings = settings or OrientationSettings()
    width, height = observations.size_wh
    centre = np.array([width / 2, height / 2]) if pp is None else np.asarray(pp, dtype=np.float64)
    unit = settings.unit_widths * max(width, height)
    numbers, lines = _usable_lines(observations, centre, unit, settings)
    check_observations(name, observations, len(lines), len(lines), settings.confidence)
    rough_vp1 = estimate_vp1(lines, settings=settings.vp1).direction
    tracks = [observations.tracks[k] for k in numbers]
    min_depth_px = settings.groups.min_depth * unit
    vehicles = group_vehicles(tracks, _horizon_px(rough_vp1, centre, unit), min_depth_px, settings.groups)
    count = _count_vehicles(vehicles, lines, settings.min_track_length)
    check_observations(name, observations, len(lines), count, settings.confidence)
    weights = _track_weights(lines, rough_vp1, vehicles, settings)
    vp1 = refine_vp1(lines, rough_vp1, vehicles, weights, settings.vp1)
    along_share = float(np.average(vp1.inliers, weights=weights * lines.length))
    curvature_deg = estimate_curvature_deg(lines, vp1, weights, settings.curvature)
    check_vp1(name, along_share, curvature_deg, settings.confidence)

    edges = normalize_edgelets(observations.edgelets, centre, unit, settings.vp2)
    road = lines.centre[vp1.inliers]
    power = min(1.0, settings.edges_per_vehicle * count / max(len(edges), 1))
    vp2 = estimate_vp2(edges, vp1.direction, width / unit, road=road, likelihood_power=power, settings=settings.vp2)
    check_vp2(name, vp2.support, vp2.support_share, float(np.degrees(vp2.tilt_sd)), settings.confidence)
    inputs = OrientationInputs(unit, width / unit, numbers, vehicles, road, edges, power, vp2, settings.vp2)
    spread = resampled_spread(
        TrackSample(lines, vehicles, weights, vp1, settings.vp1),
        EdgeSample(edges, observations.edgelets[:, 4], road, width / unit, power, vp2, settings.vp2),
        settings.resampling,
    )
    evidence = CalibrationEvidence(
        vehicles=count,
        tracks=len(lines),
        edges=len(edges),
        along_share=along_share,
        curvature_deg=curvature_deg,
        vp2_edges=vp2.support,
        vp2_share=vp2.support_share,
        vp1_sd_deg=spread.vp1_deg,
        tilt_sd_deg=float(np.degrees(np.hypot(spread.tilt, vp2.tilt_sd))),
        focal_sd=float(np.hypot(spread.log_focal, vp2.focal_sd)),
        drift=observations.drift,
        duration_s=observations.duration_s,
    )
    camera = camera_from_angles(vp1.direction, vp2.tilt, vp2.focal, centre, unit, observations.size_wh)
    return Orientation(camera, evidence, numbers[vp1.inliers], inputs)


def camera_from_angles(
    vp1: Array, tilt: float, focal: float, pp: Array, unit: float, size_wh: tuple[int, int]
) -> Camera:
    """Return the camera of a VP1, a tilt and a focal length.

    Args:
        vp1: (3,) homogeneous, normalised.
        tilt: of the horizon, rad.
        focal: focal length, units.
        pp: (2,) px, principal point.
        unit: px per unit.
        size_wh: px of the frame.
    """
    v = vp1 * (np.sign(vp1[2]) or 1.0)
    v = v / max(float(v[2]), unit / _MAX_VP_PX * float(np.linalg.norm(v[:2])), 1e-12)
    horizon = np.array([np.cos(tilt), np.sin(tilt)])
    # With VP1 straight ahead VP2 is at infinity, which two pixel coordinates cannot hold.
    least = (focal**2 + float(v[:2] @ v[:2])) * unit / _MAX_VP_PX
    beside = float(v[:2] @ horizon)
    if abs(beside) < least:
        v[:2] += horizon * (least * (np.sign(beside) or 1.0) - beside)
    vp2, _ = orthogonal_vanishing_points(np.array([*v[:2], 1.0]), np.array(tilt), np.array(focal))
    return Camera(pp + unit * v[:2], pp + unit * vp2[:2] / vp2[2], pp, image_wh=size_wh)


def _usable_lines(
    observations: Observations, pp: Array, unit: float, settings: OrientationSettings
) -> tuple[NDArray[np.int64], TrackLines]:
    """Return the tracks long and straight enough to be lines: their numbers (N,) and the lines."""
    lines = track_lines(observations.tracks, pp, unit, settings.lines)
    max_scatter = settings.max_scatter_share * lines.length + settings.scatter_px * lines.pixel
    usable = (lines.length > settings.min_track_length) & (lines.scatter < max_scatter)
    return np.flatnonzero(usable), lines[usable]


def _track_weights(lines: TrackLines, vp1: Array, vehicles: NDArray[np.int64], settings: OrientationSettings) -> Array:
    """Return the importance (N,) of tracks: vehicles with many do not count more in proportion."""
    weights = np.asarray(np.bincount(vehicles)[vehicles].astype(np.float64) ** -0.5)
    outer = outer_tracks(lines, vp1, vehicles, settings.groups)
    if np.count_nonzero(outer) >= settings.min_outer_tracks:
        weights = weights * np.where(outer, 1.0, settings.inner_weight)
    return weights


def _horizon_px(vp1: Array, pp: Array, unit: float) -> float:
    """Return y of the horizon where VP1 is; far above the frame where that is at infinity."""
    return float(pp[1] + unit * np.clip(vp1[1] / vp1[2] if abs(vp1[2]) > 1e-3 else -np.inf, -5.0, 5.0))


def _count_vehicles(vehicles: NDArray[np.int64], lines: TrackLines, min_length: float) -> int:
    """Return how many of the groups of tracks are more than a stray feature."""
    several = np.bincount(vehicles) > 1
    length = np.zeros(len(several))
    np.maximum.at(length, vehicles, lines.length)
    return int(np.count_nonzero(several & (length > 2 * min_length)))
