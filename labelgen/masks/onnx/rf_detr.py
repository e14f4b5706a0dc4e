"""RF-DETR for segmentation, as its own export writes it.

Outputs: boxes (B, Q, 4) as centre x, y, width, height from 0 to 1; class logits (B, Q, classes + 1); mask logits
(B, Q, h, w) over the whole picture. The picture is the frame, resized to a square and normalised as for ImageNet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.masks.onnx.candidates import Candidates
from labelgen.masks.onnx.family import Trial, box_corners
from labelgen.masks.onnx.network_classes import NOT_A_VEHICLE
from labelgen.masks.onnx.placement import Placement, Window, stretch

__all__ = ["RfDetr", "match_rf_detr"]

_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32).reshape(3, 1, 1)
_STD = np.array([0.229, 0.224, 0.225], dtype=np.float32).reshape(3, 1, 1)
_BOX_NAMES = ("dets", "boxes", "pred_boxes")


@dataclass(frozen=True)
class RfDetr:
    """How to read RF-DETR's outputs.

    Args:
        boxes: index of the output with boxes.
        logits: index of the output with class logits.
        masks: index of the output with mask logits.
        class_count: number of class logits.
    """

    boxes: int
    logits: int
    masks: int
    class_count: int
    title = "RF-DETR"

    def place(self, window: Window, picture_wh: tuple[int, int]) -> Placement:
        """See `Family.place`."""
        return stretch(window, picture_wh)

    def normalise(self, pictures: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Family.normalise`."""
        pictures -= _MEAN
        pictures /= _STD
        return pictures

    def read(
        self,
        outputs: Sequence[NDArray[Any]],
        index: int,
        picture_wh: tuple[int, int],
        classes: NDArray[np.uint8],
        min_score: float,
    ) -> Candidates:
        """See `Family.read`."""
        vehicles = np.flatnonzero(classes != NOT_A_VEHICLE)
        logits = np.clip(outputs[self.logits][index][:, vehicles], -80, 80)
        scores = (1 / (1 + np.exp(-logits))).astype(np.float32)
        best = scores.max(axis=1)
        chosen = np.flatnonzero(best >= min_score)
        boxes = box_corners(outputs[self.boxes][index][chosen]) * np.array([*picture_wh, *picture_wh], dtype=np.float32)
        masks = outputs[self.masks][index]
        return Candidates(
            boxes, classes[vehicles[scores[chosen].argmax(axis=1)]], best[chosen], lambda some: masks[chosen[some]]
        )


def match_rf_detr(trial: Trial) -> RfDetr | None:
    """Return how to read the network if it is one of these; None otherwise."""
    shapes = [output.shape for output in trial.outputs]
    ranks = [len(shape) for shape in shapes]
    if sorted(ranks) != [3, 3, 4]:
        return None
    masks = ranks.index(4)
    boxes, logits = (i for i in range(3) if i != masks)
    swapped = shapes[boxes][-1] != 4 or (shapes[logits][-1] == 4 and trial.output_names[logits] in _BOX_NAMES)
    if swapped:
        boxes, logits = logits, boxes
    if shapes[boxes][-1] != 4 or len({shape[:2] for shape in shapes}) != 1:
        return None
    return RfDetr(boxes, logits, masks, shapes[logits][-1])
