"""Networks in ONNX files, on tiny graphs that are made here: each family's outputs, read to the same vehicles."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx_graphs import (
    COCO_NAMES,
    Found,
    mask_grid,
    rf_detr,
    torchvision_mask_rcnn,
    write_network,
    yolo_end_to_end,
    yolo_raw,
)

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import VehicleClass
from labelgen.masks import InstanceMasks, MaskOptions, create_mask_source
from labelgen.masks.class_names import parse_classes

# A frame of 256x128 with a car and a truck. In a picture of 128x128 it is half as large, 32 px below the top; the edges
# lie on the borders of the mask grid's cells, where masks end exactly.
FRAME = np.zeros((128, 256, 3), dtype=np.uint8)
VEHICLES = {(16, 32, 64, 80): VehicleClass.CAR, (128, 16, 208, 112): VehicleClass.TRUCK}
LETTERBOXED = [Found((8, 48, 32, 72), 2, 0.9), Found((64, 40, 104, 88), 7, 0.75)]
UNPADDED = [Found((8, 16, 32, 40), 2, 0.9), Found((64, 8, 104, 56), 7, 0.75)]
STRETCHED = [Found((8, 32, 32, 80), 3, 0.9), Found((64, 16, 104, 112), 8, 0.75)]
COCO_IDS = [Found((16, 32, 64, 80), 3, 0.9), Found((128, 16, 208, 112), 8, 0.75)]
SQUARE, WIDE = (128, 128), (128, 64)
NAMES = {"names": {**{i: f"thing {i}" for i in range(80)}, **COCO_NAMES}, "task": "segment"}

FAMILIES: dict[str, tuple[dict[str, Any], list[int | str], dict[str, Any]]] = {
    "raw": (yolo_raw(LETTERBOXED, SQUARE), [1, 3, 128, 128], NAMES),
    "raw without names": (yolo_raw(LETTERBOXED, SQUARE), [1, 3, 128, 128], {}),
    "raw, channels last": (yolo_raw(LETTERBOXED, SQUARE, channels_last=True), [1, 3, 128, 128], NAMES),
    "raw, batch of 3": (yolo_raw(LETTERBOXED, SQUARE), [3, 3, 128, 128], NAMES),
    "raw, any batch": (yolo_raw(LETTERBOXED, SQUARE), ["N", 3, 128, 128], NAMES),
    "raw, any size": (yolo_raw(UNPADDED, WIDE), ["N", 3, "H", "W"], {**NAMES, "imgsz": [128, 128]}),
    "end to end": (yolo_end_to_end(LETTERBOXED, SQUARE), [1, 3, 128, 128], {**NAMES, "end2end": True}),
    "end to end, unstated": (yolo_end_to_end(LETTERBOXED, SQUARE), ["N", 3, 128, 128], NAMES),
    "rf-detr": (rf_detr(STRETCHED, SQUARE), [1, 3, 128, 128], {}),
    "rf-detr, any batch": (rf_detr(STRETCHED, SQUARE), ["N", 3, 128, 128], {}),
}


def check_vehicles(masks: InstanceMasks) -> None:
    assert dict(zip(map(tuple, masks.boxes_xyxy.tolist()), masks.class_ids.tolist(), strict=True)) == VEHICLES
    # Linear interpolation rounds the corners off.
    assert all(crop.mean() > 0.97 for crop in masks.crops)
    assert masks.are_predicted
    np.testing.assert_allclose(masks.scores, [0.9, 0.75], atol=1e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_gives_the_same_vehicles(family: str, dtype: Any, tmp_path: Path) -> None:
    outputs, shape, metadata = FAMILIES[family]
    path = write_network(tmp_path / "net.onnx", outputs, shape, dtype=dtype, metadata=metadata)
    source = create_mask_source(f"onnx:{path}", device="cpu")
    assert source.masks([]) == []
    for count in (1, 5):
        masks = source.masks([FRAME] * count)
        assert len(masks) == count
        for one in masks:
            check_vehicles(one)
    assert source.problems == []


@pytest.mark.parametrize("pasted", [True, False])
@pytest.mark.parametrize("shape", [[3, "H", "W"], [1, 3, "H", "W"]])
def test_torchvision_gives_the_same_vehicles(shape: list[Any], pasted: bool, tmp_path: Path) -> None:
    outputs = torchvision_mask_rcnn(COCO_IDS, (256, 128), pasted=pasted)
    path = write_network(tmp_path / "net.onnx", outputs, shape, per_picture=False)
    for masks in create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME] * 2):
        check_vehicles(masks)


def test_classes_go_before_the_networks_own_names(tmp_path: Path) -> None:
    outputs = yolo_raw([Found((8, 48, 32, 72), 0, 0.9), Found((64, 40, 104, 88), 1, 0.75)], SQUARE, classes=2)
    shape = [1, 3, 128, 128]
    named = write_network(tmp_path / "a.onnx", outputs, shape, metadata={"names": {0: "tuk-tuk", 1: "Lorry"}})
    nameless = write_network(tmp_path / "b.onnx", outputs, shape)
    (tmp_path / "names.txt").write_text("minivan\nlorry\n")
    (tmp_path / "pairs.txt").write_text("# ours\n0=car\n1 = truck\n")
    for path, classes in (
        (named, "tuktuk=bus,tuk_tuk=car"), (named, "0=car"), (nameless, "0=van,1=lorry"),
        (nameless, str(tmp_path / "names.txt")), (nameless, str(tmp_path / "pairs.txt")),
    ):  # fmt: skip
        if "tuktuk" in classes:
            with pytest.raises(DataError, match=r"no class tuktuk \(found tuk-tuk, Lorry\)"):
                create_mask_source(f"onnx:{path}", options=MaskOptions(classes=parse_classes(classes)), device="cpu")
            classes = classes.partition(",")[2]
        source = create_mask_source(f"onnx:{path}", options=MaskOptions(classes=parse_classes(classes)), device="cpu")
        check_vehicles(source.masks([FRAME])[0])
    only_lorry = create_mask_source(f"onnx:{named}", device="cpu").masks([FRAME])[0]
    assert only_lorry.class_ids.tolist() == [VehicleClass.TRUCK]
    with pytest.raises(DataError, match=r"2 classes without names, numbered from 0.*as 0=car"):
        create_mask_source(f"onnx:{nameless}", device="cpu")


def test_one_vehicle_gets_one_mask(tmp_path: Path) -> None:
    # A truck found as a bus as well, and its cab as a car; a box around the car and another vehicle beside it.
    cab, bus = Found((64, 40, 104, 56), 2, 0.6), Found((63, 40, 104, 89), 5, 0.7)
    outputs = yolo_raw([*LETTERBOXED, cab, bus], SQUARE)
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata=NAMES)
    check_vehicles(create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME])[0])
    second, around = Found((36, 48, 60, 72), 2, 0.75), Found((8, 48, 60, 72), 7, 0.8)
    outputs = yolo_raw([LETTERBOXED[0], second, around], SQUARE)
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata=NAMES)
    masks = create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME])[0]
    assert masks.boxes_xyxy.tolist() == [[16, 32, 64, 80], [72, 32, 120, 80]]


def test_boxes_cut_masks_beyond_a_margin_only(tmp_path: Path) -> None:
    # The box ends 1 px short of the mask on the left, and 8 px on the right.
    outputs = yolo_raw([Found((8, 48, 32, 72), 2, 0.9)], SQUARE)
    outputs["output0"][:4, -1] = 16.5, 60, 15, 24
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata=NAMES)
    masks = create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME])[0]
    assert masks.boxes_xyxy.tolist() == [[16, 32, 52, 80]]


def test_parts_far_away_are_dropped(tmp_path: Path) -> None:
    outputs = yolo_raw([Found((8, 48, 72, 72), 2, 0.9)], SQUARE)
    grid = outputs["output1"][0]
    grid[:, 10:11] = grid[:, 16:] = -8  # a narrow gap, as a lamp post's, and a wide one
    grid[12:18, 17] = 8
    grid[12:18, 13:16] = -8
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata=NAMES)
    masks = create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME])[0]
    assert masks.boxes_xyxy.tolist() == [[16, 32, 104, 80]]
    assert not masks.full(0)[:, 80:88].any()


RAW = yolo_raw(LETTERBOXED, SQUARE)
WRONG: dict[str, tuple[dict[str, Any], list[Any], dict[str, Any], str]] = {
    "detection": ({"output0": RAW["output0"]}, [1, 3, 128, 128], {}, r"output0 \(1, 86, 336\); expected YOLO's"),
    "grey": (RAW, [1, 1, 128, 128], {}, r"expected a network with one input of pictures.*\[1, 1, 128, 128\]"),
    "flat": (RAW, [1, 3], {}, "expected a network with one input of pictures"),
    "huge": (RAW, [1, 3, 128, 100000], {}, "larger than 8192 px"),
    "no vehicles": (RAW, [1, 3, 128, 128], {"names": {i: f"cat {i}" for i in range(80)}}, r"found cat 0.*cat 0=car"),
    "deep names": (RAW, [1, 3, 128, 128], {"names": "[" * 5000}, ""),
    "logits": ({**RAW, "output0": RAW["output0"] * 9}, [1, 3, 128, 128], NAMES, "a class score of 8.1: expected"),
}


@pytest.mark.parametrize("case", WRONG)
def test_networks_that_cannot_be_read_are_refused(case: str, tmp_path: Path) -> None:
    outputs, shape, metadata, message = WRONG[case]
    path = write_network(tmp_path / "net.onnx", outputs, shape, metadata=metadata)
    if not message:
        check_vehicles(create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME])[0])
        return
    with pytest.raises(DataError, match=message) as caught:
        create_mask_source(f"onnx:{path}", device="cpu").masks([FRAME])
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_files_that_are_no_networks_are_refused(tmp_path: Path) -> None:
    whole = write_network(tmp_path / "net.onnx", RAW, [1, 3, 128, 128]).read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:-1000] + bytes(1000), bytes(10000)):
        (tmp_path / "bad.onnx").write_bytes(content)
        with pytest.raises(DataError, match="not an ONNX network") as caught:
            create_mask_source(f"onnx:{tmp_path / 'bad.onnx'}", device="cpu")
        assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="no such file"):
        create_mask_source(f"onnx:{tmp_path / 'none.onnx'}", device="cpu")
    with pytest.raises(DataError, match="no such file"):
        create_mask_source(f"onnx:{tmp_path}", device="cpu")


def test_boxes_that_are_none_are_counted(tmp_path: Path) -> None:
    outputs = yolo_raw([*LETTERBOXED, Found((8, 8, 8, 8), 2, 0.9), Found((0, 0, np.inf, 9), 2, 0.9)], SQUARE)
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata=NAMES)
    source = create_mask_source(f"onnx:{path}", device="cpu")
    check_vehicles(source.masks([FRAME])[0])
    assert len(source.problems) == 1
    assert "2 detections skipped: without a box" in source.problems[0]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the greatest memory is counted in KiB on Linux")
def test_300_vehicles_in_a_4k_frame_need_less_than_2_gb(tmp_path: Path) -> None:
    found = [Found((x, y, x + 24, y + 16), 2, 0.9) for y in range(8, 600, 30) for x in range(4, 600, 40)]
    assert len(found) == 300
    count = len(found)
    boxes = np.array([one.box_xyxy for one in found]) / 640
    outputs = {
        "dets": np.concatenate([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]], axis=1),
        "labels": np.where(np.arange(91) == 3, 3.0, -9.0) * np.ones((count, 1)),
        "masks": np.stack([mask_grid(one.box_xyxy, (640, 640), (160, 160)) for one in found]),
    }
    path = write_network(tmp_path / "net.onnx", outputs, [1, 3, 640, 640])
    program = (
        "import re, numpy, sys; from labelgen.masks import create_mask_source\n"
        "source = create_mask_source(f'onnx:{sys.argv[1]}', device='cpu')\n"
        "frames = [numpy.zeros((2160, 3840, 3), numpy.uint8)] * source.batch_size\n"
        "masks = source.masks(frames)\n"
        # Not `getrusage`: its greatest memory counts that of the process which started this one.
        "print(len(masks[-1]), re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
    )
    done = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=True)
    vehicles, kib = map(int, done.stdout.split())
    assert vehicles == 300
    assert kib < 2 << 20, f"{kib >> 10} MiB"


def test_options_are_checked(tmp_path: Path) -> None:
    path = write_network(tmp_path / "net.onnx", RAW, [1, 3, 128, 128], metadata=NAMES)
    for options, message in (
        (MaskOptions(first_frame=1), "first_frame: only masks coco:FILE take that"),
        (MaskOptions(tiles="4"), "tiles 4: expected auto, or columns and rows as 3x2"),
    ):
        with pytest.raises(LabelgenError, match=message):
            create_mask_source(f"onnx:{path}", options=options)
    with pytest.raises(LabelgenError, match="tiles: only masks onnx:FILE take that, not masks background"):
        create_mask_source("background", options=MaskOptions(tiles="auto"))
