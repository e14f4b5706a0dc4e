"""Tiles: where they lie, and how what they show is joined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx_graphs import COCO_NAMES, Found, write_network, write_seeing_network, yolo_raw

from labelgen.errors import LabelgenError
from labelgen.geometry.camera import look_at_road
from labelgen.labels import VehicleClass
from labelgen.masks import MaskOptions, create_mask_source
from labelgen.masks.onnx.tiles import TILE_SETTINGS, choose_windows, vehicle_heights

WH = (1280, 720)
CAMERA = look_at_road(8.0, (60.0, 5.0), 1500.0, WH)


def test_heights_are_those_of_projected_cars() -> None:
    heights = vehicle_heights(CAMERA, WH)
    for x, y in ((40.0, 0.0), (90.0, 3.0), (200.0, -5.0)):
        foot, top = CAMERA.project([[x, y, 0.0], [x, y, TILE_SETTINGS.car_height_m]])
        assert heights[int(foot[1]), int(foot[0])] == pytest.approx(foot[1] - top[1], rel=0.06)
    assert vehicle_heights(look_at_road(8.0, (900.0, 5.0), 1500.0, WH), WH)[0].max() == 0


def test_auto_tiles_enlarge_the_far_road() -> None:
    heights = vehicle_heights(CAMERA, WH)
    road = np.zeros(WH[::-1], dtype=np.uint8)
    road[:, 500:780] = 255
    windows = choose_windows("auto", WH, (640, 640), CAMERA, road)
    assert windows[0] == (0, 0, *WH)
    assert 1 < len(windows) <= 1 + TILE_SETTINGS.max_tiles
    assert all(0 <= x0 < x1 <= WH[0] and 0 <= y0 < y1 <= WH[1] for x0, y0, x1, y1 in windows)
    # Each car that is large enough to be labelled is large enough in one of the pictures, as far as allowed.
    best = np.zeros(heights.shape)
    for x0, y0, x1, y1 in windows:
        scale = 640 / max(x1 - x0, y1 - y0)
        part = best[y0:y1, x0:x1]
        np.maximum(part, np.minimum(scale, TILE_SETTINGS.max_enlargement) * heights[y0:y1, x0:x1], out=part)
    seen = (road > 0) & (heights >= TILE_SETTINGS.least_px)
    assert best[seen].min() >= 0.5 * TILE_SETTINGS.wanted_px
    assert choose_windows("auto", WH, (8000, 8000), CAMERA, road) == windows[:1]


def test_grids_cover_the_frame_with_overlap() -> None:
    windows = choose_windows("3x2", WH, (640, 640), None, None)
    assert len(windows) == 7
    count = np.zeros(WH[::-1], dtype=int)
    for x0, y0, x1, y1 in windows[1:]:
        count[y0:y1, x0:x1] += 1
    assert count.min() == 1
    assert count[:, :300].max() == 2
    assert choose_windows("1x1", WH, (640, 640), None, None) == [(0, 0, *WH)]
    assert choose_windows(None, WH, (640, 640), CAMERA, None) == [(0, 0, *WH)]


@pytest.mark.parametrize("tiles", ["", "3", "0x2", "12x1", "auto "])
def test_tiles_written_otherwise_are_refused(tiles: str) -> None:
    with pytest.raises(LabelgenError, match="expected auto, or columns and rows as 3x2") as caught:
        choose_windows(tiles, WH, (640, 640), CAMERA, None)
    assert caught.value.parameters == ("tiles",)


def test_auto_needs_a_calibration(tmp_path: Path) -> None:
    outputs = yolo_raw([Found((8, 48, 32, 72), 2, 0.9)], (128, 128))
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata={"names": COCO_NAMES})
    with pytest.raises(LabelgenError, match="chosen by the calibration, and there is none here"):
        create_mask_source(f"onnx:{path}", options=MaskOptions(tiles="auto"), device="cpu")


@pytest.mark.parametrize("shape", [[1, 3, 128, 128], ["N", 3, 128, 128], ["N", 3, "H", "W"]])
@pytest.mark.parametrize("frame_wh", [(256, 128), (301, 157), (100, 180), (128, 128)])
def test_tiles_and_frame_are_joined_without_doubles(
    frame_wh: tuple[int, int], shape: list[int | str], tmp_path: Path
) -> None:
    path = write_seeing_network(tmp_path / "net.onnx", shape)
    source = create_mask_source(f"onnx:{path}", options=MaskOptions(tiles="2x2"), device="cpu")
    frames, boxes = [], []
    # In one tile, in an overlap, across borders of tiles, at the frame's border.
    for x, y, width, height in ((0.1, 0.1, 0.2, 0.2), (0.46, 0.46, 0.08, 0.08), (0.3, 0.2, 0.4, 0.5), (0.8, 0, 0.2, 1)):
        low = np.array([x * frame_wh[0], y * frame_wh[1]]).astype(int)
        high = np.ceil([(x + width) * frame_wh[0], (y + height) * frame_wh[1]]).astype(int)
        frames.append(np.zeros((*frame_wh[::-1], 3), dtype=np.uint8))
        frames[-1][low[1] : high[1], low[0] : high[0]] = 255
        boxes.append([*low, *high])
    for masks, box in zip(source.masks(frames), boxes, strict=True):
        assert masks.class_ids.tolist() == [VehicleClass.CAR]
        assert np.abs(masks.boxes_xyxy[0] - box).max() <= 1
