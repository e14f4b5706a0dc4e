"""The interface of every source of detections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Protocol

from detector.speed.detections import Detections
from detector.speed.view import MeasurementView
from labelgen.media.frames import Frame, FrameSource

__all__ = ["DetectionSource"]


class DetectionSource(Protocol):
    """Detects the vehicles of frames: with masks (`mask_detections`), or with a network (`model_detections`).

    `view`, `rejects` and `problems` may be read at any time. The last two grow while `stream` is consumed, and are
    complete when it has ended.

    Attributes:
        view: in which the detections lie; the same for all frames.
        rejects: number of candidates that gave no detection, by reason.
        problems: what was skipped so far, one line each.
    """

    @property
    def view(self) -> MeasurementView: ...
    @property
    def rejects(self) -> Counter[str]: ...
    @property
    def problems(self) -> list[str]: ...

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """Yield frames with their detections.

        Each frame is yielded once, in the order of the source, also where it has no detections; frames that the source
        cannot read are left out. The frame is the one given, not a copy.

        Args:
            frames: of the camera of `view`.

        Raises:
            LabelgenError: what reading or detecting raises, after the frames before have been yielded.
        """
        ...
