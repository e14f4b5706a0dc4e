"""What moves, where a detector says that there is a vehicle: blobs of a background model inside detections' boxes.

The outline comes from the background model, so that it is that of the moving vehicle and not of a network's coarse
mask; whether it is a vehicle, which class, and where one ends and the next begins, comes from the detections.

Source: Sochor et al., CVIU 2017 (Faster R-CNN decides, the foreground within its box gives the 3D box).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.source import BackgroundMasks
from labelgen.masks.instances import InstanceMasks, crop_mask
from labelgen.masks.source import MaskSource

__all__ = ["ConfirmedMasks", "confirmed"]

_GROWN = 0.05
_LEAST_FILLED = 0.25


class ConfirmedMasks:
    """A `MaskSource` made of two.

    Args:
        detections: which vehicles there are; only their boxes, classes and scores count.
        blobs: what moves.
    """

    name = "confirmed"

    def __init__(self, detections: MaskSource, blobs: BackgroundMasks) -> None:
        self._detections, self._blobs = detections, blobs
        self.every_frame, self.prime_frames = blobs.every_frame, blobs.prime_frames
        # The background model must follow frame by frame.
        self.batch_size = blobs.batch_size

    @property
    def problems(self) -> list[str]:
        """What either source had to skip so far."""
        return [*self._detections.problems, *self._blobs.problems]

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Learn the empty scene; see `MaskSource.prime`."""
        self._blobs.prime(frames)

    def observe(self, image: NDArray[np.uint8]) -> None:
        """See `MaskSource.observe`."""
        self._blobs.observe(image)

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """What moves inside each detection; see `MaskSource.masks`."""
        found = self._detections.masks(images, frame_numbers, file_names)
        return [confirmed(d, b) for d, b in zip(found, self._blobs.masks(images), strict=True)]


def confirmed(detections: InstanceMasks, blobs: InstanceMasks) -> InstanceMasks:
    """The blobs' pixels within each detection's box, with the detection's class and score.

    Args:
        detections, blobs: of one frame.

    Returns:
        one mask per detection whose box, a little grown, blobs fill by a quarter or more.
    """
    width, height = blobs.frame_wh
    moving = np.zeros((height, width), dtype=np.bool_)
    for (x, y), crop in zip(blobs.origins.tolist(), blobs.crops, strict=True):
        moving[y : y + crop.shape[0], x : x + crop.shape[1]] |= crop
    kept, origins, crops = [], [], []
    for i, box in enumerate(detections.boxes_xyxy.tolist()):
        margin = round(_GROWN * max(box[2] - box[0], box[3] - box[1]))
        x0, y0 = max(0, box[0] - margin), max(0, box[1] - margin)
        part = _largest(moving[y0 : box[3] + margin, x0 : box[2] + margin])
        cut = crop_mask(part, (x0, y0))
        if cut is not None and cut[1].sum() >= _LEAST_FILLED * (box[2] - box[0]) * (box[3] - box[1]):
            kept.append(i)
            origins.append(cut[0])
            crops.append(cut[1])
    return InstanceMasks(
        blobs.frame_wh,
        np.array(origins, dtype=np.int64).reshape(-1, 2),
        tuple(crops),
        detections.class_ids[kept],
        detections.scores[kept],
    )


def _largest(part: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Without the corners of other blobs that reach in: parts at least a fifth as large as the largest."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part.view(np.uint8))
    if count < 3:
        return part
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= 0.2 * areas.max()))
