"""One pass over a video: everything that calibration needs is gathered while the frames go by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.projective import Array

__all__ = ["Collector", "Observations", "Track"]


class Collector(Protocol):
    """Something that rides on the pass over the video.

    `see` is called in order of time, a few times per second of video, with the full-size frame. When the background
    model is known `moving` is the (H, W) mask, full size, of what differs from the empty scene; None until then.
    Frames from before the model was known are shown late, with their mask, so that `moving` is None only where no
    model could be learnt at all.
    """

    def see(
        self, number: int, time_s: float, rgb: NDArray[np.uint8], moving: NDArray[np.bool_] | NDArray[np.uint8] | None
    ) -> None: ...


@dataclass(frozen=True, eq=False)
class Track:
    """One feature on something that moves.

    Args:
        times_s: (K,) seconds.
        points_px: (K, 2) px of the full frame, pixels as areas.
    """

    times_s: Array
    points_px: Array


@dataclass(frozen=True, eq=False)
class Observations:
    """What one pass over a video gave.

    Args:
        size_wh: px of the frames.
        fps: frame rate.
        duration_s: how much of the video was looked at.
        tracks: features on moving things, in order of their end.
        background: (H, W, 3) uint8 RGB, the empty road, full size; None where it could not be learnt.
        extra: what else was gathered, by name (edgelets and such), for the estimators that know it.
    """

    size_wh: tuple[int, int]
    fps: float | None
    duration_s: float
    tracks: Sequence[Track]
    background: NDArray[np.uint8] | None
    extra: dict[str, Any]
