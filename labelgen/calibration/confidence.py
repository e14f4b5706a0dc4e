"""Whether a video can carry a calibration, and how far the one it gave is to be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from labelgen.calibration.observation.collect import Observations
from labelgen.errors import CalibrationError

__all__ = [
    "CalibrationRefusedError",
    "Evidence",
    "Reason",
    "check_across",
    "check_camera",
    "check_travel",
    "doubts",
    "overall",
]

_FEWEST_VEHICLES = 5
_FEWEST_TRACKS = 12
# Shares of the picture's width: shifted by this much within seconds, the scene counts as moving; drifted in all.
_SHIFT, _SHIFTING_LOOKS, _DRIFT = 0.012, 0.4, 0.05
_LEAST_ALONG = 0.65
_BEND_DEG = 3.0
_LEAST_EDGES, _LEAST_EDGE_SHARE = 40.0, 0.06
_WORST_TILT_DEG = 2.0
# Spreads at which a figure is halfway to useless: VP1 and tilt in degrees, the focal length as a share.
_HALFWAY = {"vp1_deg": 0.8, "tilt_deg": 1.2, "focal": 0.12}


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
        message: one line that says what was seen and what to do.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class Evidence:
    """What a calibration rests on.

    Args:
        vehicles, tracks, edges: how many there were.
        along_share: share of the tracks, by vehicle, that go along VP1.
        bend_deg: by how much the road turns.
        across_edges, across_share: edges that point to VP2 in excess of chance, and their share.
        vp1_deg, tilt_deg, focal: spread, over resamples at first: degrees, degrees, and a share of the focal length.
        drift: share of the picture's width.
        seconds: how much video was looked at.
        seen_again: vehicles whose silhouettes at several distances had a say; 0 where none had.
    """

    vehicles: int
    tracks: int
    edges: int
    along_share: float
    bend_deg: float
    across_edges: float
    across_share: float
    vp1_deg: float
    tilt_deg: float
    focal: float
    drift: float
    seconds: float
    seen_again: int = 0

    def to_dict(self) -> dict[str, Any]:
        """For the `confidence` object of the calibration file."""
        return {
            "vp1": {
                "vehicles": self.vehicles,
                "tracks": self.tracks,
                "along_share": round(self.along_share, 3),
                "bend_deg": round(self.bend_deg, 2),
                "spread_deg": round(self.vp1_deg, 3),
                "vehicles_seen_again": self.seen_again,
            },
            "vp2": {
                "edges": self.edges,
                "across_edges": round(self.across_edges),
                "across_share": round(self.across_share, 3),
                "tilt_spread_deg": round(self.tilt_deg, 3),
            },
            "focal": {"spread_percent": round(100 * self.focal, 2)},
            "camera_drift_percent": round(100 * self.drift, 2),
            "seconds": round(self.seconds, 1),
        }


def check_camera(name: str, seen: Observations, tracks: int, vehicles: int) -> None:
    """Refuse what cannot even be begun with.

    Args:
        name: of the video, for the message.
        seen: what the pass gave.
        tracks, vehicles: how many are fit for use.

    Raises:
        CalibrationRefusedError: the camera moves, nothing moves, or too little does.
    """
    if len(seen.shifts):
        shifting = float((seen.shifts > _SHIFT).mean())
        if shifting > _SHIFTING_LOOKS or seen.drift > _DRIFT:
            how = (
                f"the whole scene shifts in {shifting:.0%} of the looks"
                if shifting > _SHIFTING_LOOKS
                else f"it turns by {seen.drift:.0%} of the picture's width"
            )
            raise CalibrationRefusedError(
                Reason.MOVING_CAMERA, f"{name}: moving camera: {how}; calibrate a part in which it is fixed"
            )
    if tracks == 0:
        raise CalibrationRefusedError(
            Reason.NOTHING_MOVES,
            f"{name}: nothing moves during {seen.duration_s:.0f} s; calibrate from a time with traffic",
        )
    if vehicles < _FEWEST_VEHICLES or tracks < _FEWEST_TRACKS:
        raise CalibrationRefusedError(
            Reason.TOO_FEW_VEHICLES,
            f"{name}: too few vehicles: about {vehicles} ({tracks} tracks) in {seen.duration_s:.0f} s, at least "
            f"{_FEWEST_VEHICLES} are needed; give more video",
        )


def check_travel(name: str, along_share: float, bend_deg: float) -> None:
    """Refuse a scene without one direction of travel.

    Raises:
        CalibrationRefusedError: traffic crosses, or the road bends.
    """
    if abs(bend_deg) > _BEND_DEG:
        raise CalibrationRefusedError(
            Reason.CURVED_ROAD,
            f"{name}: curved road: it turns by about {abs(bend_deg):.1f} degrees while vehicles are seen; choose a "
            "view of a straight stretch",
        )
    if along_share < _LEAST_ALONG:
        raise CalibrationRefusedError(
            Reason.NO_COMMON_DIRECTION,
            f"{name}: no common direction of travel: only {along_share:.0%} of the tracks agree on one, as at a "
            "crossing; choose a view of one straight road",
        )


def check_across(name: str, edges: float, share: float, tilt_deg: float) -> None:
    """Refuse a scene without edges across the road.

    Args:
        name: of the video.
        edges, share: that point to VP2, in excess of chance.
        tilt_deg: how well they tell the tilt of the horizon.

    Raises:
        CalibrationRefusedError: too few of them.
    """
    if edges < _LEAST_EDGES or share < _LEAST_EDGE_SHARE or tilt_deg > _WORST_TILT_DEG:
        raise CalibrationRefusedError(
            Reason.NO_PERPENDICULAR_EDGES,
            f"{name}: no perpendicular edges: only {max(edges, 0):.0f} edges on vehicles ({max(share, 0):.1%}) point "
            "across the road; give more video, or a sharper one",
        )


def doubts(evidence: Evidence) -> list[str]:
    """What to be careful about, one line each."""
    out = []
    if evidence.vehicles < 3 * _FEWEST_VEHICLES:
        out.append(f"only about {evidence.vehicles} vehicles")
    if evidence.along_share < 0.85:
        out.append(f"only {evidence.along_share:.0%} of the tracks go along the road")
    if abs(evidence.bend_deg) > 0.4 * _BEND_DEG:
        out.append(f"the road may bend: it turns by about {abs(evidence.bend_deg):.1f} degrees")
    if evidence.vp1_deg > 0.5:
        out.append(f"VP1 is known to {evidence.vp1_deg:.1f} degrees only")
    if evidence.tilt_deg > 1.0:
        out.append(f"the horizon's tilt is known to {evidence.tilt_deg:.1f} degrees only")
    if evidence.focal > 0.08:
        out.append(f"the focal length is known to {evidence.focal:.0%} only")
    if evidence.drift > 0.01:
        out.append(f"the camera drifts by {evidence.drift:.1%} of the picture's width")
    return out


def overall(evidence: Evidence) -> float:
    """One figure from 0 to 1: the product of how far each spread is from useless, and of the shares that agree."""
    spreads = (evidence.vp1_deg, evidence.tilt_deg, evidence.focal)
    parts = [1 / (1 + (spread / half) ** 2) for spread, half in zip(spreads, _HALFWAY.values(), strict=True)]
    parts.append(float(np.clip((evidence.along_share - 0.5) / 0.4, 0, 1)))
    parts.append(1 / (1 + (evidence.bend_deg / _BEND_DEG) ** 4))
    parts.append(evidence.vehicles / (evidence.vehicles + _FEWEST_VEHICLES))
    return round(float(np.prod(parts)), 3)
