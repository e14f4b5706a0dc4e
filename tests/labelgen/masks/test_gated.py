"""Silhouettes gated by detections, on masks drawn by hand."""

from __future__ import annotations

from typing import cast

import numpy as np

from labelgen.labels import VehicleClass
from labelgen.masks import InstanceMasks, MaskSource
from labelgen.masks.background.source import BackgroundMasks
from labelgen.masks.gated import GatedMasks

WH = (100, 60)


class FixedMasks:
    """A mask source with the same masks for every frame."""

    every_frame, prime_frames, batch_size = 5, 100, 1

    def __init__(self, masks: InstanceMasks, problem: str) -> None:
        self._masks, self.problems = masks, [problem]

    def masks(self, images: list[np.ndarray], *_: object) -> list[InstanceMasks]:
        return [self._masks] * len(images)


def boxes(*boxes_xyxy: tuple[int, int, int, int], class_id: VehicleClass, score: float) -> InstanceMasks:
    masks = []
    for x0, y0, x1, y1 in boxes_xyxy:
        masks.append(np.zeros(WH[::-1], dtype=bool))
        masks[-1][y0:y1, x0:x1] = True
    return InstanceMasks.from_masks(WH, masks, [class_id] * len(masks), [score] * len(masks))


def test_silhouettes_are_cut_by_detections_and_take_their_class() -> None:
    # Two trucks side by side are one silhouette; the third detection does not move.
    detections = boxes((10, 10, 30, 30), (32, 10, 52, 30), (70, 10, 90, 30), class_id=VehicleClass.TRUCK, score=0.75)
    silhouettes = boxes((12, 12, 50, 29), class_id=VehicleClass.VEHICLE, score=1.0)
    source = GatedMasks(
        cast("MaskSource", FixedMasks(detections, "a")), cast("BackgroundMasks", FixedMasks(silhouettes, "b"))
    )
    (masks,) = source.masks([np.zeros((*WH[::-1], 3), dtype=np.uint8)])
    # Boxes grow by 5 % of their side, one pixel.
    assert masks.boxes_xyxy.tolist() == [[12, 12, 31, 29], [31, 12, 50, 29]]
    assert masks.class_ids.tolist() == [VehicleClass.TRUCK] * 2
    assert masks.scores.tolist() == [0.75, 0.75]
    assert source.problems == ["a", "b"]
    assert (source.every_frame, source.prime_frames, source.batch_size) == (5, 100, 1)
