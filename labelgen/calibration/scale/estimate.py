"""What every way to a scale gives, and the camera it is measured in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import CalibrationError
from labelgen.geometry import Camera

__all__ = ["ScaleEstimate", "time_blocks", "unit_camera"]


@dataclass(frozen=True)
class ScaleEstimate:
    """A camera's scale.

    Args:
        scale: metres per unit of the public road-plane convention.
        count: how many vehicles or distances it rests on.
        spread: its standard deviation over resamples, as a share of it; NaN where there is nothing to resample.
        method: "auto-dimensions", "auto-models" or "distance".
        details: figures by name, for the report.
    """

    scale: float
    count: int
    spread: float
    method: str
    details: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise CalibrationError(f"scale, {self.method}: what was measured gives none ({self.scale}); measure again")


def unit_camera(camera: Camera) -> Camera:
    """The camera with scale 1: its metres are the units in which the scale is counted."""
    return replace(camera, scale=1.0)


def time_blocks(times_s: NDArray[np.float64], block_s: float) -> list[NDArray[np.int64]]:
    """Numbers of the entries that belong to each stretch of time: sightings of one vehicle stay together."""
    number = np.floor(np.asarray(times_s) / block_s)
    return [np.flatnonzero(number == value) for value in np.unique(number)]
