"""The whole calibration of a video, from its frames to a camera with a confidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from labelgen.calibration.confidence import CalibrationRefusedError, doubts, overall_confidence
from labelgen.calibration.observation.collect import Observations, ObservationSettings, observe
from labelgen.calibration.observation.silhouettes import SilhouetteCollector, SilhouetteSettings, VehicleSilhouette
from labelgen.calibration.scale.estimate import ScaleEstimate
from labelgen.calibration.vanishing.bundle_adjustment import BundleAdjustmentSettings, refine_orientation
from labelgen.calibration.vanishing.orientation import Orientation, OrientationSettings, estimate_orientation
from labelgen.geometry import Camera
from labelgen.media.frames import FrameSource
from labelgen.media.open_frames import open_frames

__all__ = ["Calibration", "CalibrationSettings", "calibrate_video"]


@dataclass(frozen=True)
class CalibrationSettings:
    """When the pass over a video ends early, and the settings of its stages.

    Smaller standard deviations and more vehicles before the end cost time and change the result less and less.
    """

    enough_duration_s: float = 75.0
    """Least time of the video before an early end, seconds."""
    enough_vehicles: int = 120
    """Fewest vehicles before an early end; the scale needs them too."""
    enough_vp1_sd_deg: float = 0.15
    """Largest standard deviation of VP1 at an early end, degrees."""
    enough_tilt_sd_deg: float = 0.25
    """Largest standard deviation of the tilt at an early end, degrees."""
    enough_focal_sd: float = 0.025
    """Largest relative standard deviation of the focal length at an early end."""
    observation: ObservationSettings = field(default_factory=ObservationSettings)
    """Of the pass over the video."""
    silhouettes: SilhouetteSettings = field(default_factory=SilhouetteSettings)
    """Of the silhouettes."""
    orientation: OrientationSettings = field(default_factory=OrientationSettings)
    """Of vanishing points and focal length, from tracks and edges."""
    bundle_adjustment: BundleAdjustmentSettings = field(default_factory=BundleAdjustmentSettings)
    """Of the same, from silhouettes too."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera from its video alone.

    Args:
        camera: with a scale where one was estimated.
        orientation: VP1, VP2 and focal length with what they rest on.
        scale: likewise; None where none was estimated.
        observations: what the pass over the video gave.
        silhouettes: of vehicles, from the same pass.
    """

    camera: Camera
    orientation: Orientation
    scale: ScaleEstimate | None
    observations: Observations
    silhouettes: Sequence[VehicleSilhouette]

    @property
    def doubts(self) -> list[str]:
        """What to be careful about, one line each."""
        return doubts(self.orientation.evidence)

    def confidence(self) -> dict[str, Any]:
        """Return the `confidence` object: one figure from 0 to 1, what each result rests on, and the doubts."""
        evidence = self.orientation.evidence
        out: dict[str, Any] = {"overall": overall_confidence(evidence), **evidence.to_dict()}
        if self.scale is not None:
            out["scale"] = {
                "method": self.scale.method,
                "count": self.scale.count,
                "spread_percent": round(100 * self.scale.spread, 2) if math.isfinite(self.scale.spread) else None,
                **self.scale.details,
            }
        return {**out, "doubts": self.doubts}

    def to_dict(self) -> dict[str, Any]:
        """Return the public calibration format with a `confidence` object beside it."""
        return {**self.camera.to_dict(), "confidence": self.confidence()}


def calibrate_video(
    source: str | Path | FrameSource,
    *,
    pp: ArrayLike | None = None,
    duration_s: float | None = None,
    stop_early: bool = True,
    settings: CalibrationSettings | None = None,
) -> Calibration:
    """Calibrate a fixed camera above a straight road from its video; the scale stays open.

    Args:
        source: a video file, a folder of images, or an opened source.
        pp: (2,) px, principal point; the frame's centre when None.
        duration_s: length of the video's beginning to use, seconds; None for all of it.
        stop_early: end the pass when resampling changes the result no more.
        settings: thresholds.

    Raises:
        CalibrationRefusedError: the video cannot carry a calibration; says why.
        DataError: the video cannot be read.
    """
    stages = settings or CalibrationSettings()
    frames = open_frames(source) if isinstance(source, str | Path) else source

    def enough(observations: Observations) -> bool:
        if observations.duration_s < stages.enough_duration_s:
            return False
        try:
            evidence = estimate_orientation(frames.name, observations, pp, stages.orientation).evidence
        except CalibrationRefusedError:
            return False
        return (
            evidence.vp1_sd_deg < stages.enough_vp1_sd_deg
            and evidence.tilt_sd_deg < stages.enough_tilt_sd_deg
            and evidence.focal_sd < stages.enough_focal_sd
            and evidence.vehicles >= stages.enough_vehicles
        )

    collector = SilhouetteCollector(stages.silhouettes)
    observations = observe(
        frames,
        duration_s=duration_s,
        silhouettes=collector,
        enough=enough if stop_early else None,
        settings=stages.observation,
    )
    silhouettes = collector.silhouettes()
    orientation = estimate_orientation(frames.name, observations, pp, stages.orientation)
    orientation = refine_orientation(observations, orientation, silhouettes, stages.bundle_adjustment)
    return Calibration(replace(orientation.camera, name=frames.name), orientation, None, observations, silhouettes)
