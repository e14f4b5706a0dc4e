"""Ultralytics' exports of YOLOv8, 11 and 26 for segmentation: raw heads, and end-to-end ones.

Raw: (B, 4 + classes + M, anchors), of each anchor centre x, y, width, height in px of the picture, class scores, and M
coefficients. End to end: (B, K, 6 + M), of each detection x0, y0, x1, y1, score, class and M coefficients. Both with
prototypes (B, M, h, w): a mask's logits are the coefficients' sum of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.masks.onnx.candidates import Candidates, MaskLogits
from labelgen.masks.onnx.family import Trial, box_corners, checked_scores
from labelgen.masks.onnx.network_classes import NOT_A_VEHICLE
from labelgen.masks.onnx.placement import Placement, Window, letterbox

__all__ = ["YoloEndToEnd", "YoloRaw", "match_yolo"]

_BOX, _BOX_SCORE_CLASS = 4, 6
_STRIDES = (8, 16, 32)


@dataclass(frozen=True)
class _Yolo:
    """What both heads have in common: letterboxed pictures from 0 to 1.

    Args:
        head: index of the output with boxes.
        prototypes: index of the output with prototypes.
        class_count: number of classes.
    """

    head: int
    prototypes: int
    class_count: int

    def place(self, window: Window, picture_wh: tuple[int, int]) -> Placement:
        """See `Family.place`."""
        return letterbox(window, picture_wh)

    def normalise(self, pictures: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `Family.normalise`."""
        return pictures


@dataclass(frozen=True)
class YoloRaw(_Yolo):
    """A head of anchors, before any suppression.

    Args:
        channels_last: whether the head is (B, anchors, 4 + classes + M).
    """

    channels_last: bool = False
    title = "YOLO with a raw head"

    def read(
        self,
        outputs: Sequence[NDArray[Any]],
        index: int,
        picture_wh: tuple[int, int],
        classes: NDArray[np.uint8],
        min_score: float,
    ) -> Candidates:
        """See `Family.read`."""
        head = outputs[self.head][index]
        if self.channels_last:
            head = head.T
        vehicles = np.flatnonzero(classes != NOT_A_VEHICLE)
        # Of other classes nothing is asked: a lorry that is a train with 0.5 and a truck with 0.4 is a truck.
        scores = head[_BOX + vehicles]
        best = scores.max(axis=0)
        chosen = np.flatnonzero(best >= min_score)
        kinds = vehicles[scores[:, chosen].argmax(axis=0)]
        coefficients = head[_BOX + self.class_count :, chosen].T
        return Candidates(
            box_corners(head[:_BOX, chosen].T),
            classes[kinds],
            checked_scores(best[chosen]),
            _combine(coefficients, outputs[self.prototypes][index]),
        )


@dataclass(frozen=True)
class YoloEndToEnd(_Yolo):
    """A head whose boxes have been selected by the network itself."""

    title = "YOLO, end to end"

    def read(
        self,
        outputs: Sequence[NDArray[Any]],
        index: int,
        picture_wh: tuple[int, int],
        classes: NDArray[np.uint8],
        min_score: float,
    ) -> Candidates:
        """See `Family.read`."""
        head = outputs[self.head][index]
        numbers = head[:, 5]
        known = np.flatnonzero((head[:, 4] >= min_score) & (numbers >= 0) & (numbers < len(classes)))
        chosen = known[classes[numbers[known].astype(np.int64)] != NOT_A_VEHICLE]
        return Candidates(
            head[chosen, :_BOX],
            classes[numbers[chosen].astype(np.int64)],
            checked_scores(head[chosen, 4]),
            _combine(head[chosen, _BOX_SCORE_CLASS:], outputs[self.prototypes][index]),
        )


def match_yolo(trial: Trial) -> YoloRaw | YoloEndToEnd | None:
    """Return how to read the network if it is one of these; None otherwise."""
    if len(trial.outputs) != 2:
        return None
    ranks = [output.ndim for output in trial.outputs]
    if sorted(ranks) != [3, 4]:
        return None
    head, prototypes = ranks.index(3), ranks.index(4)
    _, first, last = trial.outputs[head].shape
    masks = trial.outputs[prototypes].shape[1]
    count = 1 + max(trial.names) if trial.names else 0
    stated = trial.metadata.get("end2end", "").lower() == "true" or "'nms': True" in trial.metadata.get("args", "")
    if stated and last == _BOX_SCORE_CLASS + masks:
        return YoloEndToEnd(head, prototypes, count)
    anchors = sum((trial.picture_wh[0] // s) * (trial.picture_wh[1] // s) for s in _STRIDES)
    for channels, others, channels_last in ((first, last, False), (last, first, True)):
        classes = channels - _BOX - masks
        if classes >= 1 and (classes == count or not count) and (others == anchors or not channels_last):
            if not channels_last and not count and others != anchors:
                continue
            return YoloRaw(head, prototypes, classes, channels_last)
    if last == _BOX_SCORE_CLASS + masks:
        return YoloEndToEnd(head, prototypes, count)
    return None


def _combine(coefficients: NDArray[np.float32], prototypes: NDArray[np.float32]) -> MaskLogits:
    flat = prototypes.reshape(len(prototypes), -1)

    def logits(chosen: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.asarray(coefficients[chosen] @ flat, dtype=np.float32).reshape(-1, *prototypes.shape[1:])

    return logits
