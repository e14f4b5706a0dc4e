"""What detections come from: the interface of every source, and of a network that looks at rectified pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections
from detector.speed.measurement import View
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Rectification
from labelgen.labels import Labels
from labelgen.media.frames import Frame, FrameSource

__all__ = ["DetectionSource", "Detector", "DetectorDetections"]


class DetectionSource(Protocol):
    """Frames in, detections out.

    Attributes:
        view: where the detections lie.
        rejects: how many candidates gave no detection, by reason.
        problems: what had to be skipped so far, one line each.
    """

    @property
    def view(self) -> View: ...
    @property
    def rejects(self) -> Counter[str]: ...
    @property
    def problems(self) -> list[str]: ...

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """Each frame with its detections, in order."""
        ...


class Detector(Protocol):
    """A network: rectified pictures in, boxes with c_c and scores out.

    Attributes:
        batch_size: how many pictures it takes at once at best.
    """

    @property
    def batch_size(self) -> int: ...

    def rectifier(self, rectification: Rectification, camera: Camera) -> Callable[[NDArray[np.uint8]], Any]:
        """Turns a frame (H, W, 3) uint8 BGR of a camera into a rectified picture as `detect` takes it."""
        ...

    def detect(self, pictures: Sequence[Any]) -> list[Labels]:
        """The vehicles in each rectified picture, in its px, with scores."""
        ...


class DetectorDetections:
    """A detector as a `DetectionSource`.

    Args:
        detector: sees the rectified pictures.
        view: of a variant with a rectified picture.
        batch: frames at a time; 1 keeps the delay of a live camera low, the detector's own number by default.

    Raises:
        LabelgenError: the view has no rectified picture.
    """

    def __init__(self, detector: Detector, view: View, *, batch: int | None = None) -> None:
        if view.rectification is None:
            raise LabelgenError(f"--variant {view.variant}: it needs masks; a detector sees rectified pictures only")
        self.view, self.rejects, self.problems = view, Counter[str](), list[str]()
        self._detector, self._batch = detector, batch or detector.batch_size
        self._rectify = detector.rectifier(view.rectification, view.camera)

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """See `DetectionSource.stream`."""
        return self.detections(frames.frames())

    def detections(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, Detections]]:
        """Each of some frames with its detections, in order."""
        coming = iter(frames)
        while batch := list(islice(coming, self._batch)):
            labels = self._detector.detect([self._rectify(frame.image) for frame in batch])
            for frame, found in zip(batch, labels, strict=True):
                placed, valid = self.view.place(
                    frame.number, frame.time_s, found.boxes_xyxy, found.cc, found.scores, found.class_ids
                )
                if not valid.all():
                    self.rejects["no valid 3D box"] += int(np.count_nonzero(~valid))
                yield frame, placed
