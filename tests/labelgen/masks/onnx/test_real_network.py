"""A real network on real frames, against a few lines that use onnxruntime by hand."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
import pytest
import torch

from labelgen.masks import create_mask_source
from labelgen.masks.onnx.crops import CROP_SETTINGS
from labelgen.masks.onnx.network_classes import class_table
from labelgen.masks.onnx.session import NetworkSession
from labelgen.media.open_frames import open_frames

REAL = Path(os.environ.get("LABELGEN_REAL_DATA") or "none")
NETWORK = REAL / "models" / "yolov8n-seg.onnx"
VIDEOS = ("city_road_640x360.mp4", "motorway_848x478.mp4", "i_highway_1280x720.mp4", "freeway_320x240.avi")
SCORE, SIDE = 0.35, 640

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not NETWORK.is_file(), reason="LABELGEN_REAL_DATA is not set: no real network on this machine"),
]


def by_hand(session: Any, image: np.ndarray) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return score, box in px of the frame and mask (H, W) of each vehicle, best first."""
    height, width = image.shape[:2]
    scale = min(SIDE / width, SIDE / height)
    wide, high = round(width * scale), round(height * scale)
    left, top = (SIDE - wide) // 2, (SIDE - high) // 2
    canvas = np.full((SIDE, SIDE, 3), 114, dtype=np.uint8)
    canvas[top : top + high, left : left + wide] = cv2.resize(image, (wide, high))
    picture = canvas[:, :, ::-1].transpose(2, 0, 1)[None].astype(np.float32) / 255
    head, prototypes = session.run(None, {"images": picture})
    rows = head[0].T
    scores = rows[:, [4 + 2, 4 + 3, 4 + 5, 4 + 7]].max(axis=1)
    rows, scores = rows[scores >= SCORE], scores[scores >= SCORE]
    boxes = np.column_stack([rows[:, :2] - rows[:, 2:4] / 2, rows[:, :2] + rows[:, 2:4] / 2])
    kept = cv2.dnn.NMSBoxes(np.column_stack([boxes[:, :2], rows[:, 2:4]]).tolist(), scores.tolist(), SCORE, 0.7)
    found = []
    for i in np.array(kept).ravel().astype(int):
        logits = torch.from_numpy(np.tensordot(rows[i, -32:], prototypes[0], 1)[None, None])
        inside = torch.nn.functional.interpolate(logits, (SIDE, SIDE), mode="bilinear")[..., top : top + high, :]
        full = torch.nn.functional.interpolate(inside[..., left : left + wide], (height, width), mode="bilinear")
        margin = max(CROP_SETTINGS.margin_px, CROP_SETTINGS.margin_share * max(rows[i, 2:4]))
        box = (boxes[i] - [left, top, left, top]) / scale
        x0, y0, x1, y1 = box + np.array([-1, -1, 1, 1]) * margin / scale
        x, y = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
        found.append((scores[i], box, (full[0, 0].numpy() > 0) & (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)))
    return found


def boxes_of_source(source: Any, image: np.ndarray) -> np.ndarray:
    """Return the boxes (N, 4) px of the frame that the source reads from the network, before any suppression."""
    placement = source.family.place((0, 0, image.shape[1], image.shape[0]), (SIDE, SIDE))
    blob = cv2.dnn.blobFromImage(placement.picture(image), 1 / 255, swapRB=True)
    classes = class_table(NETWORK, 80, None, None)
    outputs = NetworkSession(NETWORK, device="cpu").run(blob)
    return placement.boxes_to_frame(source.family.read(outputs, 0, (SIDE, SIDE), classes, SCORE).boxes_xyxy)


def test_boxes_and_masks_are_those_of_onnxruntime_by_hand() -> None:
    session = onnxruntime.InferenceSession(str(NETWORK), providers=["CPUExecutionProvider"])
    source = create_mask_source(f"onnx:{NETWORK}", score_threshold=SCORE, device="cpu")
    compared = 0
    for name in VIDEOS:
        frames = open_frames(REAL / "videos" / name)
        for frame in frames.frames(lambda number: number in (30, 60, 90, 120, 150)):
            ours = source.masks([frame.image])[0]
            theirs = by_hand(session, frame.image)
            compared += len(ours)
            if theirs:
                differences = np.abs(boxes_of_source(source, frame.image)[:, None] - [box for _, box, _ in theirs])
                assert differences.max(axis=-1).min(axis=0).max() <= 0.5
            assert len(theirs) - 2 <= len(ours) <= len(theirs)  # some are second masks of a vehicle
            for i in range(len(ours)):
                mask = ours.full(i)
                ious = [(mask & other).sum() / (mask | other).sum() for _, _, other in theirs]
                best = int(np.argmax(ious))
                assert ious[best] >= 0.98, (name, frame.number, i)
                assert ours.scores[i] == pytest.approx(theirs[best][0], abs=1e-3)
    assert compared >= 60
