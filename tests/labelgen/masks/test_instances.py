"""The masks of one frame, as every source gives them, and choosing a source by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import VehicleClass
from labelgen.masks import InstanceMasks, create_mask_source, crop_mask


def two_masks() -> tuple[np.ndarray, np.ndarray]:
    one, two = np.zeros((48, 64), dtype=bool), np.zeros((48, 64), dtype=bool)
    one[10:20, 5:25] = True
    one[10, 5] = False
    two[40:48, 60:64] = True
    return one, two


def test_from_whole_frame_masks_and_back() -> None:
    masks = two_masks()
    found = InstanceMasks.from_masks((64, 48), masks, [VehicleClass.CAR, VehicleClass.BUS], [0.5, 1.0])
    assert len(found) == 2
    assert found.boxes_xyxy.tolist() == [[5, 10, 25, 20], [60, 40, 64, 48]]
    assert found.class_ids.tolist() == [1, 3]
    for i, mask in enumerate(masks):
        np.testing.assert_array_equal(found.full(i), mask)


def test_no_masks() -> None:
    nothing = InstanceMasks.empty((64, 48))
    assert len(nothing) == 0
    assert nothing.boxes_xyxy.shape == (0, 4)
    assert nothing.origins.shape == (0, 2)


def test_crop_mask_takes_any_type_and_no_pixels() -> None:
    mask = np.zeros((6, 8), dtype=np.float32)
    assert crop_mask(mask) is None
    mask[2, 3:5] = 0.1
    cropped = crop_mask(mask, (100, 200))
    assert cropped is not None
    assert cropped[0] == (103, 202)
    assert cropped[1].tolist() == [[True, True]]


GOOD: dict[str, Any] = {
    "frame_wh": (64, 48),
    "origins": np.array([[1, 2]]),
    "crops": (np.ones((3, 4), dtype=bool),),
    "class_ids": np.array([1]),
    "scores": np.array([0.9]),
}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"origins": np.zeros((2, 2))}, r"origins: expected shape \(1, 2\), got \(2, 2\)"),
        ({"scores": np.zeros(3), "class_ids": np.zeros(2)}, r"class_ids: .*; scores: "),
        ({"scores": np.array([1.5])}, r"scores: expected values in \[0, 1\]"),
        ({"scores": np.array([np.nan])}, "scores"),
        ({"class_ids": np.array([77])}, "class_ids: expected values of VehicleClass"),
        ({"origins": np.array([[62, 2]])}, "inside the frame 64x48, got 4x3 px at"),
        ({"origins": np.array([[-1, 2]])}, "inside the frame"),
        ({"crops": (np.zeros((3, 4), dtype=bool),)}, "at least one pixel"),
        ({"crops": (np.ones((3, 4)),)}, "expected a bool array"),
    ],
)
def test_refuses_what_does_not_fit_together(wrong: dict[str, Any], message: str) -> None:
    assert len(InstanceMasks(**GOOD)) == 1
    with pytest.raises(DataError, match=message):
        InstanceMasks(**{**GOOD, **wrong})


@pytest.mark.parametrize("spec", ["", "coco", "coco:", "yolo", "background:5", "maskrcnn:x"])
def test_unknown_source_names_the_known_ones(spec: str) -> None:
    with pytest.raises(LabelgenError, match=r"use one of maskrcnn, background, coco:FILE"):
        create_mask_source(spec)


def test_weights_are_for_maskrcnn_only(tmp_path: Path) -> None:
    with pytest.raises(LabelgenError, match="only the mask source maskrcnn takes weights"):
        create_mask_source("background", weights=tmp_path / "x.pt")
