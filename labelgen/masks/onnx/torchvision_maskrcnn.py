"""torchvision's Mask R-CNN, exported to ONNX.

Outputs: boxes (N, 4) in px of the picture; labels (N,); scores (N,); masks (N, 1, h, w) of probabilities, either over
the whole picture or over the box. There is one picture, RGB from 0 to 1; the network normalises it itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.masks.onnx.candidates import Candidates
from labelgen.masks.onnx.family import Trial, checked_scores
from labelgen.masks.onnx.network_classes import NOT_A_VEHICLE
from labelgen.masks.onnx.placement import Placement, Window, letterbox

__all__ = ["TorchvisionMaskRcnn", "match_torchvision"]

_MASK_THRESHOLD = np.float32(0.5)


@dataclass(frozen=True)
class TorchvisionMaskRcnn:
    """How to read the outputs of torchvision's Mask R-CNN.

    Args:
        boxes, labels, scores, masks: index of each output.
    """

    boxes: int
    labels: int
    scores: int
    masks: int
    class_count = 0
    title = "torchvision's Mask R-CNN"

    def place(self, window: Window, picture_wh: tuple[int, int]) -> Placement:
        """See `Family.place`."""
        return letterbox(window, picture_wh)

    def normalise(self, pictures: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Family.normalise`."""
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
        labels, scores, masks = outputs[self.labels], outputs[self.scores], outputs[self.masks]
        known = np.flatnonzero((scores >= min_score) & (labels >= 0) & (labels < len(classes)))
        chosen = known[classes[labels[known].astype(np.int64)] != NOT_A_VEHICLE]
        return Candidates(
            np.asarray(outputs[self.boxes][chosen], dtype=np.float32),
            classes[labels[chosen].astype(np.int64)],
            checked_scores(scores[chosen]),
            lambda some: masks[chosen[some], 0] - _MASK_THRESHOLD,
            fill_box=masks.shape[-2:] != (picture_wh[1], picture_wh[0]),
        )


def match_torchvision(trial: Trial) -> TorchvisionMaskRcnn | None:
    """Return how to read the network if it is one of these; None otherwise."""
    outputs = trial.outputs
    if sorted(output.ndim for output in outputs) != [1, 1, 2, 4]:
        return None
    boxes = next(i for i, output in enumerate(outputs) if output.ndim == 2)
    masks = next(i for i, output in enumerate(outputs) if output.ndim == 4)
    labels = [i for i, output in enumerate(outputs) if output.ndim == 1 and output.dtype.kind in "iu"]
    scores = [i for i, output in enumerate(outputs) if output.ndim == 1 and output.dtype.kind == "f"]
    if len(labels) != 1 or len(scores) != 1 or outputs[boxes].shape[1] != 4 or outputs[masks].shape[1] != 1:
        return None
    if len({len(output) for output in outputs}) != 1:
        return None
    return TorchvisionMaskRcnn(boxes, labels[0], scores[0], masks)
