"""Good files of every kind that labelgen reads, small, and the commands that read them."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch

from detector.checkpoint import ModelMetadata
from detector.model.retinanet import ModelConfig, build_model
from labelgen.cli.main import main as run_command
from labelgen.geometry import Camera, Pair, road_cuboids
from tools.benchmarks.score import synthetic_recording

__all__ = [
    "FRAMES",
    "FRAME_WH",
    "SHORT_TRAINING",
    "VIDEOS",
    "Case",
    "Rng",
    "bcs_masks",
    "make_good_files",
    "scene_options",
]

Rng = np.random.Generator
Case = tuple[Sequence[object], str]
"""Arguments of the command, and what was changed."""

FRAME_WH = (320, 180)
_CAMERA = Camera(np.array([-66.5, -83.5]), np.array([1216.5, -150.0]), np.array([160.0, 90.0]), 0.12, FRAME_WH, "road")
_ROAD_M = np.array([[20.0, -4.0], [20.0, -22.0], [70.0, -22.0], [70.0, -4.0]])
FRAMES = 8
SHORT_TRAINING = ("--preset", "small", "--steps-per-epoch", 1, "--batch", 1, "--device", "cpu", "--weights", "none")
VIDEOS = {"mp4": "libx264", "avi": "mpeg4", "mkv": "libx264", "ts": "mpeg2video", "mjpeg": "mjpeg"}
"""Suffixes of the good videos road.*, and their codecs."""


def make_good_files(root: Path) -> None:
    """Write one good file of each kind."""
    rng = np.random.default_rng(0)
    frames = root / "road"
    frames.mkdir(parents=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    ground = cv2.resize(rng.integers(90, 130, (45, 80, 3), dtype=np.uint8), FRAME_WH)
    for n in range(FRAMES):
        picture = ground.copy()
        images.append({"id": n, "file_name": f"{n:03d}.png", "width": FRAME_WH[0], "height": FRAME_WH[1]})
        x = 36.0 - 1.2 * n
        near = np.array([[x, -9.0], [x + 5.0, -15.0]])
        boxes = _CAMERA.project(road_cuboids(near, np.array([[4.4, 1.8, 1.5], [5.2, 2.0, 2.1]])))
        for vertices in boxes:
            hull = cv2.convexHull(vertices.astype(np.float32))[:, 0]
            cv2.fillConvexPoly(picture, np.round(hull).astype(np.int32), (30, 60, 200))
            segmentation = [np.round(hull, 2).ravel().tolist()]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": n,
                    "category_id": 3,
                    "segmentation": segmentation,
                    "score": 0.9,
                }
            )
        cv2.imwrite(str(frames / f"{n:03d}.png"), picture)
    _write_videos(root)
    coco = {"images": images, "annotations": annotations, "categories": [{"id": 3, "name": "car"}]}
    (root / "masks.json").write_text(json.dumps(coco))
    (root / "road.calibration.json").write_text(json.dumps(_CAMERA.to_dict()))
    mask = np.zeros(FRAME_WH[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round(_CAMERA.project(_ROAD_M)).astype(np.int32), 255)
    cv2.imwrite(str(root / "road.mask.png"), mask)
    _run_good(*bcs_masks(root, root / "shards"))
    _run_good(
        "speed", root / "road", "--from", f"masks:coco:{root / 'masks.json'}", "--fps", 10, *scene_options(root),
        "--out", root / "speeds",
    )  # fmt: skip
    _make_tree(root / "tree", rng)
    _make_checkpoint(root / "last.ckpt")
    _run_good("train", root / "shards", *SHORT_TRAINING, "--epochs", 1, "--out", root / "run")
    recording = synthetic_recording(6, 1)
    for name in ("dataset", "results"):
        (root / name / "session4_left").mkdir(parents=True)
    (root / "dataset" / "session4_left" / "gt_data.pkl").write_bytes(pickle.dumps(recording.truth, protocol=2))
    (root / "results" / "session4_left" / "system_a.json").write_text(json.dumps(recording.results))


def _write_videos(root: Path) -> None:
    """Write the pictures of the folder as a video of each kind."""
    pictures = [cv2.imread(str(path)) for path in sorted((root / "road").glob("*.png"))]
    for suffix, codec in VIDEOS.items():
        with av.open(str(root / f"road.{suffix}"), "w", format={"ts": "mpegts"}.get(suffix)) as container:
            stream: Any = container.add_stream(codec, rate=25 if codec == "mpeg2video" else 10)
            stream.width, stream.height = FRAME_WH
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for picture in pictures:
                frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
                container.mux(stream.encode(frame.reformat(format=stream.pix_fmt)))
            container.mux(stream.encode(None))


def _run_good(*arguments: object) -> None:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            run_command([str(argument) for argument in arguments])
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{arguments}: {printed.getvalue()}") from None


def scene_options(root: Path, **other: Path) -> list[object]:
    return [
        "--calibration", other.get("calibration", root / "road.calibration.json"),
        "--road-mask", other.get("mask", root / "road.mask.png"),
    ]  # fmt: skip


def bcs_masks(root: Path, out: Path, **other: Path) -> list[object]:
    masks = f"coco:{other.get('masks', root / 'masks.json')}"
    frames = other.get("frames", root / "road")
    return [
        "bcs-masks",
        frames,
        "--masks",
        masks,
        "--every",
        2,
        "--size",
        "160x96",
        "--out",
        out,
        *scene_options(root, **other),
    ]


def _make_tree(root: Path, rng: Rng) -> None:
    near = np.array([[30.0, -9.0]])
    vertices = _CAMERA.project(road_cuboids(near, np.array([[4.4, 1.8, 1.5]])))[0]
    low, high = np.floor(vertices.min(0)) - 8, np.ceil(vertices.max(0)) + 8
    crop = rng.integers(0, 255, (int(high[1] - low[1]), int(high[0] - low[0]), 3), dtype=np.uint8)
    (root / "images").mkdir(parents=True)
    instances = []
    for i in range(3):
        cv2.imwrite(str(root / "images" / f"{i}.png"), crop)
        instances.append(
            {"2DBB": np.zeros(4), "3DBB": vertices, "3DBB_offset": low, "instance_id": i, "path": f"{i}.png"}
        )
    camera = {key: getattr(_CAMERA, key) for key in ("vp1", "vp2", "vp3", "pp")}
    sample = {"camera": "uvoz", "to_camera": True, "annotation": "a car", "instances": instances}
    (root / "dataset.pkl").write_bytes(pickle.dumps({"cameras": {"uvoz": camera}, "samples": [sample]}, protocol=2))


def _make_checkpoint(path: Path) -> None:
    config = ModelConfig(
        backbone="resnet18", levels=(3, 4, 5), channels=16, head_convs=1, head_norm="group",
        anchor_sizes=((16.0,), (32.0,), (64.0,)), anchor_ratios=(1.0,),
    )  # fmt: skip
    torch.manual_seed(0)
    state = {f"model.{key}": value for key, value in build_model(config).state_dict().items()}
    labels = [{"samples": 1, "weight": 1.0, "producers": [], "settings": [{"kind": "masks"}], "sha256": []}]
    metadata = ModelMetadata("small", Pair.VP2_VP3, (160, 96), config, 0.0, labels, {"seed": 0})
    torch.save({"state_dict": state, "labelgen": metadata.to_dict(), "epoch": 0, "global_step": 1}, path)
