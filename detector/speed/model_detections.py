"""A trained detector as a source of detections: its view of a scene, and its boxes placed in the frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np

from detector.checkpoint import ModelMetadata
from detector.inference import Detector
from detector.speed.detections import Detections
from detector.speed.measurement import MeasurementView, Variant
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Rectification, Region, RoadMask
from labelgen.media.frames import Frame, FrameSource

__all__ = ["DetectorDetections", "model_view"]


def model_view(
    metadata: ModelMetadata, camera: Camera, road: RoadMask, variant: Variant | None = None
) -> MeasurementView:
    """The view of a scene in which a model's detections lie.

    Args:
        metadata: of its checkpoint.
        camera: with a scale.
        road: the road mask.
        variant: how the measured point is found; by default with c_c where the model has it, on the part of the
            frame that it has seen in training, or in the frame itself.

    Raises:
        LabelgenError: the variant needs pictures of another kind, or c_c from a model that has none.
        RectificationError: the scene admits no rectification of the model's pair and size.
    """
    region = metadata.region
    solid, flat = {
        Region.ROAD: (Variant.TRANSFORM3D, Variant.TRANSFORM2D),
        Region.FRAME: (Variant.PREVIOUS3D, Variant.PREVIOUS2D),
        Region.NONE: (Variant.ORIG2D, Variant.ORIG2D),
    }[region]
    chosen = variant or (solid if metadata.config.cc_weight else flat)
    if chosen not in (solid, flat):
        kind = "frames as they are" if region is Region.NONE else f"rectifications of the {region}"
        known = " or ".join(dict.fromkeys((solid, flat)))
        raise LabelgenError(f"--variant {chosen}: this detector was trained on {kind}; use {known}")
    if region is Region.NONE:
        rectification = Rectification.of_region(region, camera, road, metadata.pair, metadata.size_wh)
        return MeasurementView(chosen, camera, rectification)
    if chosen.is_3d and not metadata.config.cc_weight:
        raise LabelgenError(f"--variant {chosen}: this detector was trained without c_c; use {flat}")
    return MeasurementView.create(chosen, camera, road, metadata.pair, metadata.size_wh)


class DetectorDetections:
    """A detector as a `DetectionSource`.

    Args:
        detector: of the view's pair and size.
        view: of a variant with a rectified picture.
        batch: frames at a time; None for `Detector.batch_size`. 1 keeps the delay of a live camera low.

    Raises:
        LabelgenError: the view has no rectified picture.
    """

    def __init__(self, detector: Detector, view: MeasurementView, *, batch: int | None = None) -> None:
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
            batch_labels = self._detector.detect([self._rectify(frame.image) for frame in batch])
            for frame, labels in zip(batch, batch_labels, strict=True):
                placed, valid = self.view.place(
                    frame.number, frame.time_s, labels.boxes_xyxy, labels.cc, labels.scores, labels.class_ids
                )
                if not valid.all():
                    self.rejects["no valid 3D box"] += int(np.count_nonzero(~valid))
                yield frame, placed
