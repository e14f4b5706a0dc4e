"""The result of every method for the scale."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import CalibrationError

__all__ = ["USE_DISTANCE", "ScaleEstimate", "time_blocks"]

USE_DISTANCE = "use more of the video, or a known distance, distance:x1,y1,x2,y2,METRES"
"""What to do where the video carries no scale; see `labelgen.calibration.scale.methods`."""


@dataclass(frozen=True)
class ScaleEstimate:
    """A camera's scale.

    Args:
        scale: metres per road unit, in the public road-plane convention.
        count: how many vehicles or distances it rests on.
        spread: relative standard deviation over resamples; NaN where there is nothing to resample.
        method: "auto-dimensions", "auto-models" or "distance".
        details: figures by name, for the report.

    Raises:
        CalibrationError: the scale is not a positive number.
    """

    scale: float
    count: int
    spread: float
    method: str
    details: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise CalibrationError(f"scale, {self.method}: what was measured gives none ({self.scale}); measure again")


def time_blocks(times_s: NDArray[np.float64], block_s: float) -> list[NDArray[np.int64]]:
    """Return the numbers of the entries in each stretch of time: silhouettes of one vehicle stay together.

    Args:
        times_s: (N,) seconds.
        block_s: length of a stretch, seconds.
    """
    number = np.floor(np.asarray(times_s) / block_s)
    return [np.flatnonzero(number == value) for value in np.unique(number)]
