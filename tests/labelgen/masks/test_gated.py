"""Silhouettes gated by detections, on masks drawn by hand."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest
from onnx_graphs import write_seeing_network

from labelgen.errors import LabelgenError
from labelgen.labels import VehicleClass
from labelgen.masks import InstanceMasks, MaskSource, create_mask_source
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


def test_gated_is_a_source_of_its_own(tmp_path: Path) -> None:
    path = write_seeing_network(tmp_path / "net.onnx", [1, 3, 128, 128])
    source = create_mask_source(f"gated:onnx:{path}", device="cpu")
    assert (source.every_frame > 0, source.prime_frames > 0, source.batch_size) == (True, True, 1)
    rng = np.random.default_rng(0)
    empty = [rng.integers(50, 60, (160, 240, 3)).astype(np.uint8) for _ in range(12)]
    source.prime(empty)
    source.observe(empty[0])
    # A car that the network knows, and what moves beside it: too dark for the network to see.
    frame = empty[1].copy()
    frame[60:110, 40:100] = 255
    frame[60:110, 150:200] = 5
    (masks,) = source.masks([frame])
    assert masks.class_ids.tolist() == [VehicleClass.CAR]
    assert np.abs(masks.boxes_xyxy[0] - [40, 60, 100, 110]).max() <= 3
    assert masks.scores.tolist() == [np.float32(0.9)]
    (nothing,) = source.masks([empty[2]])
    assert len(nothing) == 0


@pytest.mark.parametrize("masks", ["gated", "gated:", "gated:background", "gated:onnx", "gated:gated:onnx:x", "onnx"])
def test_only_detections_can_gate(masks: str) -> None:
    with pytest.raises(LabelgenError, match="gated:maskrcnn, gated:coco:FILE, gated:onnx:FILE"):
        create_mask_source(masks)


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
