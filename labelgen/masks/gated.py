"""Silhouettes of a background model, gated by detections: what moves inside the box of a detected vehicle.

The outline comes from the background model, which follows it more closely than a network's coarse mask. Whether there
is a vehicle, its class, and the border between two vehicles come from the detections.

Source: Sochor et al., CVIU 2017 (Faster R-CNN detects, the foreground within its box gives the 3D box).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.source import BackgroundMasks
from labelgen.masks.instances import InstanceMasks, crop_mask
from labelgen.masks.source import MaskSource

__all__ = ["GatedMasks"]

# A detection's box is enlarged by this share of its longer side: networks cut off bumpers and wheels.
_MARGIN_SHARE = 0.05
# Least share of a detection's box that silhouettes fill. A smaller share keeps detections of parked vehicles.
_MIN_FILLED_SHARE = 0.25
# Least area of a separate piece, relative to the largest: smaller ones are corners of other vehicles.
_MIN_PIECE_SHARE = 0.2


class GatedMasks:
    """A `labelgen.masks.source.MaskSource` made of two.

    Args:
        detections: finds the vehicles; only their boxes, classes and scores are used.
        silhouettes: finds what moves.
    """

    def __init__(self, detections: MaskSource, silhouettes: BackgroundMasks) -> None:
        self._detections, self._silhouettes = detections, silhouettes
        self.every_frame, self.prime_frames = silhouettes.every_frame, silhouettes.prime_frames
        # The background model must be updated between any two frames.
        self.batch_size = silhouettes.batch_size

    @property
    def problems(self) -> list[str]:
        """What both sources have skipped so far."""
        return [*self._detections.problems, *self._silhouettes.problems]

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Learn the empty scene; see `MaskSource.prime`."""
        self._silhouettes.prime(frames)

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Update the empty scene; see `MaskSource.observe`."""
        self._silhouettes.observe(image)

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """Return what moves inside each detection; see `MaskSource.masks`."""
        detections = self._detections.masks(images, frame_numbers, file_names)
        silhouettes = self._silhouettes.masks(images)
        return [_gate(d, s) for d, s in zip(detections, silhouettes, strict=True)]


def _gate(detections: InstanceMasks, silhouettes: InstanceMasks) -> InstanceMasks:
    """Return the silhouettes' pixels within each detection's enlarged box, with the detection's class and score.

    Detections whose boxes are not filled enough are left out.
    """
    width, height = silhouettes.frame_wh
    moving = np.zeros((height, width), dtype=np.bool_)
    for (x, y), crop in zip(silhouettes.origins.tolist(), silhouettes.crops, strict=True):
        moving[y : y + crop.shape[0], x : x + crop.shape[1]] |= crop
    indices, crops = [], []
    for i, box in enumerate(detections.boxes_xyxy.tolist()):
        margin = round(_MARGIN_SHARE * max(box[2] - box[0], box[3] - box[1]))
        x0, y0 = max(0, box[0] - margin), max(0, box[1] - margin)
        pieces = _drop_small_pieces(moving[y0 : box[3] + margin, x0 : box[2] + margin])
        cropped = crop_mask(pieces, (x0, y0))
        if cropped is not None and cropped[1].sum() >= _MIN_FILLED_SHARE * (box[2] - box[0]) * (box[3] - box[1]):
            indices.append(i)
            crops.append(cropped)
    return InstanceMasks.from_crops(
        silhouettes.frame_wh, crops, detections.class_ids[indices], detections.scores[indices]
    )


def _drop_small_pieces(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask without pieces much smaller than the largest, which are corners of other vehicles."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    if count < 3:
        return mask
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= _MIN_PIECE_SHARE * areas.max()))
