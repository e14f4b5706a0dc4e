"""What detections come from: the interface of every source, and of a network that looks at rectified pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from detector.detections import Detections
from detector.variants import View
from labelgen.errors import LabelgenError
from labelgen.labels import Labels
from labelgen.sources.frames import Frame, FrameSource

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

    def detect(self, images: Sequence[NDArray[np.uint8]]) -> list[Labels]:
        """The vehicles in each rectified picture (H, W, 3) uint8 BGR, in its px, with scores."""
        ...


class DetectorDetections:
    """A detector as a `DetectionSource`.

    Args:
        detector: sees the rectified pictures.
        view: of a variant with a rectified picture.

    Raises:
        LabelgenError: the variant has none.
    """

    def __init__(self, detector: Detector, view: View) -> None:
        if view.rectification is None:
            raise LabelgenError(f"--variant {view.variant}: it needs masks; a detector sees rectified pictures only")
        self.view, self.rejects, self.problems = view, Counter[str](), list[str]()
        self._detector, self._rectification = detector, view.rectification

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """See `DetectionSource.stream`."""
        coming = frames.frames()
        while batch := list(islice(coming, self._detector.batch_size)):
            labels = self._detector.detect([self._rectification.warp_image(frame.image) for frame in batch])
            for frame, found in zip(batch, labels, strict=True):
                placed, valid = self.view.place(
                    frame.number, frame.time_s, found.boxes_xyxy, found.cc, found.scores, found.class_ids
                )
                if not valid.all():
                    self.rejects["no valid 3D box"] += int(np.count_nonzero(~valid))
                yield frame, placed
