"""What detections come from: the interface of every source, and of a network that looks at rectified pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Protocol

from detector.speed.detections import Detections
from detector.speed.measurement import MeasurementView
from labelgen.media.frames import Frame, FrameSource

__all__ = ["DetectionSource"]


class DetectionSource(Protocol):
    """Frames in, detections out.

    Attributes:
        view: where the detections lie.
        rejects: how many candidates gave no detection, by reason.
        problems: what had to be skipped so far, one line each.
    """

    @property
    def view(self) -> MeasurementView: ...
    @property
    def rejects(self) -> Counter[str]: ...
    @property
    def problems(self) -> list[str]: ...

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """Each frame with its detections, in order."""
        ...
