"""Detections by a trained detector: the view of a scene that it needs, and its boxes placed in the frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from detector.speed.detections import Detections
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Rectification, Region, RoadMask
from labelgen.media.frames import Frame, FrameSource

if TYPE_CHECKING:
    from detector.checkpoint import ModelMetadata
    from detector.inference import Detector

__all__ = ["DetectorDetections", "model_variant", "model_view"]


def model_view(
    metadata: ModelMetadata, camera: Camera, road: RoadMask, variant: Variant | None = None
) -> MeasurementView:
    """Return the view of a scene in which the detections of a model lie.

    Args:
        metadata: of the checkpoint of the model.
        camera: with a scale.
        road: mask of the road.
        variant: how the measured point is found. By default it is the variant with c_c if the model has c_c, for the
            region of the frame that the model was trained on. `fitted3d` goes with any model that has c_c.

    Raises:
        LabelgenError: the variant needs images of another region, or c_c from a model without it.
        RectificationError: the scene admits no rectification of the pair and size of the model.
    """
    variant = model_variant(metadata, variant)
    if metadata.region is Region.NONE:
        rectification = Rectification.of_region(metadata.region, camera, road, metadata.pair, metadata.size_wh)
        return MeasurementView(variant, camera, rectification)
    if variant is not Variant.FITTED3D:
        return MeasurementView.create(variant, camera, road, metadata.pair, metadata.size_wh)
    # Bodies are laid over the boxes that the 3D variant decodes.
    decoding = Variant.PREVIOUS3D if metadata.region is Region.FRAME else Variant.TRANSFORM3D
    view = MeasurementView.create(decoding, camera, road, metadata.pair, metadata.size_wh)
    return replace(view, variant=variant)


def model_variant(metadata: ModelMetadata, variant: Variant | None = None) -> Variant:
    """Return how a model's detections are measured; see `model_view`.

    Raises:
        LabelgenError: the variant needs images of another region, or c_c from a model without it.
    """
    region = metadata.region
    variant_3d, variant_2d = {
        Region.ROAD: (Variant.TRANSFORM3D, Variant.TRANSFORM2D),
        Region.FRAME: (Variant.PREVIOUS3D, Variant.PREVIOUS2D),
        Region.NONE: (Variant.ORIG2D, Variant.ORIG2D),
    }[region]
    variant = variant or (variant_3d if metadata.config.cc_weight else variant_2d)
    fitted = variant is Variant.FITTED3D and region is not Region.NONE
    if not fitted and variant not in (variant_3d, variant_2d):
        kind = "frames as they are" if region is Region.NONE else f"rectifications of the {region}"
        possible = " or ".join(dict.fromkeys((variant_3d, variant_2d)))
        raise LabelgenError(
            f"variant {variant}: this detector was trained on {kind}; use {possible}", parameter="variant"
        )
    if region is not Region.NONE and variant.is_3d and not metadata.config.cc_weight:
        raise LabelgenError(
            f"variant {variant}: this detector was trained without c_c; use {variant_2d}", parameter="variant"
        )
    return variant


class DetectorDetections:
    """A detector as a `detector.speed.detection_source.DetectionSource`.

    Args:
        detector: of the pair and size of the view.
        view: of a variant with a rectified image.
        batch: frames at a time; None for `Detector.batch_size`. 1 keeps the delay of a live camera low.

    Raises:
        LabelgenError: the view has no rectified image.
    """

    def __init__(self, detector: Detector, view: MeasurementView, *, batch: int | None = None) -> None:
        if view.rectification is None:
            raise LabelgenError(
                f"variant {view.variant}: it needs masks; a detector needs rectified images", parameter="variant"
            )
        self.view, self.rejects, self.problems = view, Counter[str](), list[str]()
        self._detector, self._batch = detector, batch or detector.batch_size
        self._rectify = detector.rectifier(view.rectification, view.camera)

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """Yield frames with their detections; see `DetectionSource.stream`."""
        return self.detections(frames.frames())

    def detections(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, Detections]]:
        """Yield each of the frames with its detections, in order."""
        remaining = iter(frames)
        while batch := list(islice(remaining, self._batch)):
            batch_labels = self._detector.detect([self._rectify(frame.image) for frame in batch])
            for frame, labels in zip(batch, batch_labels, strict=True):
                placed, valid = self.view.place(
                    frame.number, frame.time_s, labels.boxes_xyxy, labels.cc, labels.scores, labels.class_ids
                )
                if not valid.all():
                    self.rejects["no valid 3D box"] += int(np.count_nonzero(~valid))
                yield frame, placed
