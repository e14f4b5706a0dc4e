"""The whole calibration of a video, from its frames to a camera with a confidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import ArrayLike

from labelgen.calibration.confidence import CalibrationRefusedError, doubts, overall
from labelgen.calibration.observation.collect import Collector, Observations, observe
from labelgen.calibration.observation.silhouettes import Blob, BlobCollector
from labelgen.calibration.vanishing.bundle_adjustment import refine_orientation
from labelgen.calibration.vanishing.orientation import Orientation, estimate_orientation
from labelgen.geometry import Camera
from labelgen.media.frames import FrameSource
from labelgen.media.open_frames import open_frames

__all__ = ["Calibration", "EstimateScale", "Scale", "calibrate_video"]

# Enough is seen when resampling moves nothing any more, with vehicles enough for their mean size as well.
_ENOUGH_VEHICLES, _ENOUGH_SECONDS = 120, 75.0
_SURE_VP1_DEG, _SURE_TILT_DEG, _SURE_FOCAL = 0.15, 0.25, 0.025


class Scale(Protocol):
    """What an estimate of the scale gives: `labelgen.calibration.scale.estimate.ScaleEstimate`."""

    @property
    def scale(self) -> float: ...
    @property
    def count(self) -> int: ...
    @property
    def spread(self) -> float: ...
    @property
    def method(self) -> str: ...
    @property
    def details(self) -> Mapping[str, float]: ...


EstimateScale = Callable[[Camera, Sequence[Blob]], Scale]


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera from its video alone.

    Args:
        camera: with a scale where one was estimated.
        orientation: what VP1 and VP2 rest on.
        scale: likewise for the scale; None where none was asked for.
        seen: what the pass over the video gave.
        blobs: silhouettes of vehicles from the same pass.
    """

    camera: Camera
    orientation: Orientation
    scale: Scale | None
    seen: Observations
    blobs: Sequence[Blob]

    @property
    def doubts(self) -> list[str]:
        """What to be careful about, one line each."""
        return doubts(self.orientation.evidence)

    def confidence(self) -> dict[str, Any]:
        """The `confidence` object: one figure from 0 to 1, what each result rests on, and the doubts."""
        evidence = self.orientation.evidence
        out: dict[str, Any] = {"overall": overall(evidence), **evidence.to_dict()}
        if self.scale is not None:
            out["scale"] = {
                "method": self.scale.method,
                "count": self.scale.count,
                "spread_percent": round(100 * self.scale.spread, 2) if math.isfinite(self.scale.spread) else None,
                **self.scale.details,
            }
        return {**out, "doubts": self.doubts}

    def to_dict(self) -> dict[str, Any]:
        """The public calibration format with a `confidence` object beside it."""
        return {**self.camera.to_dict(), "confidence": self.confidence()}


def calibrate_video(
    source: str | Path | FrameSource,
    *,
    pp: ArrayLike | None = None,
    duration_s: float | None = None,
    estimate_scale: EstimateScale | None = None,
    collectors: Sequence[Collector] = (),
    stop_early: bool = True,
) -> Calibration:
    """Calibrate a fixed camera above a straight road from its video.

    Args:
        source: a video file, a folder of images, or an opened source.
        pp: (2,) px, principal point; the picture's middle when None.
        duration_s: look at so much of the beginning at most.
        estimate_scale: called with the camera without scale and the silhouettes; None leaves the scale open.
        collectors: what else wants to see the frames.
        stop_early: stop looking when resampling moves nothing any more.

    Raises:
        CalibrationRefusedError: the video cannot carry a calibration; says why.
        DataError: the video cannot be read.
    """
    frames = open_frames(source) if isinstance(source, str | Path) else source

    def enough(seen: Observations) -> bool:
        if seen.duration_s < _ENOUGH_SECONDS:
            return False
        try:
            evidence = estimate_orientation(frames.name, seen, pp).evidence
        except CalibrationRefusedError:
            return False
        sure = evidence.vp1_deg < _SURE_VP1_DEG and evidence.tilt_deg < _SURE_TILT_DEG and evidence.focal < _SURE_FOCAL
        return sure and evidence.vehicles >= _ENOUGH_VEHICLES

    collector = BlobCollector()
    stop = enough if stop_early else None
    seen = observe(frames, duration_s=duration_s, collectors=[*collectors, collector], enough=stop)
    blobs = collector.blobs()
    orientation = refine_orientation(seen, estimate_orientation(frames.name, seen, pp), blobs)
    camera = replace(orientation.camera, name=frames.name)
    scale = None if estimate_scale is None else estimate_scale(camera, blobs)
    if scale is not None:
        camera = replace(camera, scale=scale.scale)
    return Calibration(camera, orientation, scale, seen, blobs)
