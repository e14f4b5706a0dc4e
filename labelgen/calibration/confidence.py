"""Whether a video can carry a calibration, and how far the one it gave is to be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from labelgen.calibration.observation.collect import Observations
from labelgen.errors import CalibrationError

__all__ = [
    "CalibrationEvidence",
    "CalibrationRefusedError",
    "ConfidenceSettings",
    "Reason",
    "check_observations",
    "check_vp1",
    "check_vp2",
    "doubts",
    "overall_confidence",
]


@dataclass(frozen=True)
class ConfidenceSettings:
    """When a video is refused, and what lowers the confidence.

    Refusing more keeps wrong calibrations out, and leaves more videos to be calibrated by hand.
    """

    min_vehicles: int = 5
    """Fewest vehicles; with n vehicles the confidence is at most n / (n + min_vehicles)."""
    min_tracks: int = 12
    """Fewest tracks."""
    max_shift: float = 0.012
    """Displacement within seconds, as a share of the frame's width, from which on the camera counts as moving."""
    max_shifting_share: float = 0.4
    """Largest share of the sampled frames in which it may count so: gusts of wind shift some."""
    max_drift: float = 0.05
    """Largest displacement over the whole pass, as a share of the frame's width."""
    min_along_share: float = 0.65
    """Least share of the tracks that point to VP1; crossings stay below."""
    max_curvature_deg: float = 3.0
    """Largest change of the road's heading over the visible stretch, degrees."""
    min_vp2_edges: float = 40.0
    """Fewest edges that point to VP2, in excess of chance."""
    min_vp2_share: float = 0.06
    """Least share of the edges that do."""
    max_tilt_sd_deg: float = 2.0
    """Largest standard deviation of the horizon's tilt, degrees."""
    half_vp1_sd_deg: float = 0.8
    """Standard deviation of VP1, degrees, that halves the confidence."""
    half_tilt_sd_deg: float = 1.2
    """Standard deviation of the tilt, degrees, that halves the confidence."""
    half_focal_sd: float = 0.12
    """Relative standard deviation of the focal length that halves the confidence."""
    doubtful_vehicles_factor: int = 3
    """With fewer than this multiple of `min_vehicles` the number is a doubt."""
    doubtful_along_share: float = 0.85
    """Share of the tracks that point to VP1 below which it is a doubt."""
    doubtful_curvature_share: float = 0.4
    """Share of the largest curvature above which it is a doubt."""
    doubtful_vp1_sd_deg: float = 0.5
    """Standard deviation of VP1, degrees, above which it is a doubt."""
    doubtful_tilt_sd_deg: float = 1.0
    """Standard deviation of the tilt, degrees, above which it is a doubt."""
    doubtful_focal_sd: float = 0.08
    """Relative standard deviation of the focal length above which it is a doubt."""
    doubtful_drift: float = 0.01
    """Drift of the camera, as a share of the frame's width, above which it is a doubt."""


class Reason(StrEnum):
    """Why a video cannot be calibrated from."""

    NOTHING_MOVES = "nothing moves"
    TOO_FEW_VEHICLES = "too few vehicles"
    MOVING_CAMERA = "moving camera"
    NO_COMMON_DIRECTION = "no common direction"
    CURVED_ROAD = "curved road"
    NO_PERPENDICULAR_EDGES = "no perpendicular edges"


class CalibrationRefusedError(CalibrationError):
    """The video cannot carry a calibration.

    Args:
        reason: the kind of trouble.
        message: one line that says what was observed and what to do.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class CalibrationEvidence:
    """What a calibration rests on.

    Args:
        vehicles, tracks, edges: how many there were.
        along_share: share of the tracks, weighted by vehicle and length, that point to VP1.
        curvature_deg: change of the road's heading over the visible stretch, degrees.
        vp2_edges, vp2_share: edges that point to VP2 in excess of chance, and their share.
        vp1_sd_deg, tilt_sd_deg, focal_sd: standard deviations of VP1's direction and the horizon's tilt, degrees, and
            of the focal length, relative.
        drift: of the camera, as a share of the frame's width.
        duration_s: length of the video used, seconds.
        reobserved_vehicles: vehicles whose silhouettes at several distances entered the bundle adjustment; 0 without.
    """

    vehicles: int
    tracks: int
    edges: int
    along_share: float
    curvature_deg: float
    vp2_edges: float
    vp2_share: float
    vp1_sd_deg: float
    tilt_sd_deg: float
    focal_sd: float
    drift: float
    duration_s: float
    reobserved_vehicles: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return the parts of the calibration file's `confidence` object that hold the evidence."""
        return {
            "vp1": {
                "vehicles": self.vehicles,
                "tracks": self.tracks,
                "along_share": round(self.along_share, 3),
                "bend_deg": round(self.curvature_deg, 2),
                "spread_deg": round(self.vp1_sd_deg, 3),
                "vehicles_seen_again": self.reobserved_vehicles,
            },
            "vp2": {
                "edges": self.edges,
                "across_edges": round(self.vp2_edges),
                "across_share": round(self.vp2_share, 3),
                "tilt_spread_deg": round(self.tilt_sd_deg, 3),
            },
            "focal": {"spread_percent": round(100 * self.focal_sd, 2)},
            "camera_drift_percent": round(100 * self.drift, 2),
            "seconds": round(self.duration_s, 1),
        }


def check_observations(
    name: str, observations: Observations, tracks: int, vehicles: int, settings: ConfidenceSettings
) -> None:
    """Refuse a video whose observations allow no estimate.

    Args:
        name: of the video, for the message.
        observations: what the pass gave.
        tracks, vehicles: how many are fit for use.
        settings: thresholds.

    Raises:
        CalibrationRefusedError: the camera moves, nothing moves, or too little does.
    """
    if len(observations.shifts):
        shifting = float((observations.shifts > settings.max_shift).mean())
        if shifting > settings.max_shifting_share or observations.drift > settings.max_drift:
            how = (
                f"the whole scene shifts in {shifting:.0%} of the frames"
                if shifting > settings.max_shifting_share
                else f"it turns by {observations.drift:.0%} of the picture's width"
            )
            raise CalibrationRefusedError(
                Reason.MOVING_CAMERA, f"{name}: moving camera: {how}; calibrate a part in which it is fixed"
            )
    if tracks == 0:
        raise CalibrationRefusedError(
            Reason.NOTHING_MOVES,
            f"{name}: nothing moves during {observations.duration_s:.0f} s; calibrate from a time with traffic",
        )
    if vehicles < settings.min_vehicles or tracks < settings.min_tracks:
        raise CalibrationRefusedError(
            Reason.TOO_FEW_VEHICLES,
            f"{name}: too few vehicles: about {vehicles} ({tracks} tracks) in {observations.duration_s:.0f} s, at "
            f"least {settings.min_vehicles} are needed; give more video",
        )


def check_vp1(name: str, along_share: float, curvature_deg: float, settings: ConfidenceSettings) -> None:
    """Refuse a scene without one direction of travel.

    Args:
        name: of the video, for the message.
        along_share: share of the tracks that point to VP1.
        curvature_deg: change of the road's heading, degrees.
        settings: thresholds.

    Raises:
        CalibrationRefusedError: traffic crosses, or the road bends.
    """
    if abs(curvature_deg) > settings.max_curvature_deg:
        raise CalibrationRefusedError(
            Reason.CURVED_ROAD,
            f"{name}: curved road: it turns by about {abs(curvature_deg):.1f} degrees while vehicles are seen; choose "
            "a view of a straight stretch",
        )
    if along_share < settings.min_along_share:
        raise CalibrationRefusedError(
            Reason.NO_COMMON_DIRECTION,
            f"{name}: no common direction of travel: only {along_share:.0%} of the tracks agree on one, as at a "
            "crossing; choose a view of one straight road",
        )


def check_vp2(name: str, edges: float, share: float, tilt_sd_deg: float, settings: ConfidenceSettings) -> None:
    """Refuse a scene without edges across the road.

    Args:
        name: of the video, for the message.
        edges, share: that point to VP2, in excess of chance.
        tilt_sd_deg: standard deviation of the horizon's tilt, degrees.
        settings: thresholds.

    Raises:
        CalibrationRefusedError: too few of them.
    """
    if edges < settings.min_vp2_edges or share < settings.min_vp2_share or tilt_sd_deg > settings.max_tilt_sd_deg:
        raise CalibrationRefusedError(
            Reason.NO_PERPENDICULAR_EDGES,
            f"{name}: no perpendicular edges: only {max(edges, 0):.0f} edges on vehicles ({max(share, 0):.1%}) point "
            "across the road; give more video, or a sharper one",
        )


def doubts(evidence: CalibrationEvidence, settings: ConfidenceSettings | None = None) -> list[str]:
    """Return what to be careful about, one line each."""
    settings = settings or ConfidenceSettings()
    out = []
    if evidence.vehicles < settings.doubtful_vehicles_factor * settings.min_vehicles:
        out.append(f"only about {evidence.vehicles} vehicles")
    if evidence.along_share < settings.doubtful_along_share:
        out.append(f"only {evidence.along_share:.0%} of the tracks go along the road")
    if abs(evidence.curvature_deg) > settings.doubtful_curvature_share * settings.max_curvature_deg:
        out.append(f"the road may bend: it turns by about {abs(evidence.curvature_deg):.1f} degrees")
    if evidence.vp1_sd_deg > settings.doubtful_vp1_sd_deg:
        out.append(f"VP1 is known to {evidence.vp1_sd_deg:.1f} degrees only")
    if evidence.tilt_sd_deg > settings.doubtful_tilt_sd_deg:
        out.append(f"the horizon's tilt is known to {evidence.tilt_sd_deg:.1f} degrees only")
    if evidence.focal_sd > settings.doubtful_focal_sd:
        out.append(f"the focal length is known to {evidence.focal_sd:.0%} only")
    if evidence.drift > settings.doubtful_drift:
        out.append(f"the camera drifts by {evidence.drift:.1%} of the picture's width")
    return out


def overall_confidence(evidence: CalibrationEvidence, settings: ConfidenceSettings | None = None) -> float:
    """Return one figure from 0 to 1: a product of factors for the spreads, the shares and the number of vehicles."""
    settings = settings or ConfidenceSettings()
    spreads = (
        (evidence.vp1_sd_deg, settings.half_vp1_sd_deg),
        (evidence.tilt_sd_deg, settings.half_tilt_sd_deg),
        (evidence.focal_sd, settings.half_focal_sd),
    )
    factors = [1 / (1 + (spread / half) ** 2) for spread, half in spreads]
    factors.append(float(np.clip((evidence.along_share - 0.5) / 0.4, 0, 1)))
    factors.append(1 / (1 + (evidence.curvature_deg / settings.max_curvature_deg) ** 4))
    factors.append(evidence.vehicles / (evidence.vehicles + settings.min_vehicles))
    return round(float(np.prod(factors)), 3)
