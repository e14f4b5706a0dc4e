"""What a network found in one picture, the same for all families of networks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Candidates", "MaskLogits", "suppress_boxes"]

FloatArray = NDArray[np.float32]
MaskLogits = Callable[[NDArray[np.int64]], FloatArray]
"""Return masks (K, h, w), above 0 inside, of K chosen candidates."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """N vehicles in one picture.

    Args:
        boxes_xyxy: (N, 4) float32, px of the picture.
        class_ids: (N,) uint8, `labelgen.labels.VehicleClass`.
        scores: (N,) float32 in [0, 1].
        mask_logits: returns the masks of chosen ones, as grids that span the picture or their own box.
        fill_box: whether a grid spans the candidate's own box instead of the whole picture.
    """

    boxes_xyxy: FloatArray
    class_ids: NDArray[np.uint8]
    scores: FloatArray
    mask_logits: MaskLogits
    fill_box: bool = False

    def __len__(self) -> int:
        return len(self.scores)


def suppress_boxes(
    boxes_xyxy: NDArray[np.float64], order: NDArray[np.int64], max_iou: float, limit: int
) -> NDArray[np.int64]:
    """Return which boxes remain when each one removes those that overlap it and come after it.

    Args:
        boxes_xyxy: (N, 4).
        order: (N,) indices, best first.
        max_iou: greatest intersection over union of two boxes that both remain.
        limit: greatest number of boxes that remain.

    Returns:
        (K,) indices, best first.
    """
    areas = np.prod(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], axis=1)
    kept: list[int] = []
    while order.size and len(kept) < limit:
        best, order = int(order[0]), order[1:]
        kept.append(best)
        low = np.maximum(boxes_xyxy[best, :2], boxes_xyxy[order, :2])
        high = np.minimum(boxes_xyxy[best, 2:], boxes_xyxy[order, 2:])
        shared = np.prod(np.maximum(high - low, 0), axis=1)
        order = order[shared <= max_iou * (areas[best] + areas[order] - shared)]
    return np.array(kept, dtype=np.int64)
