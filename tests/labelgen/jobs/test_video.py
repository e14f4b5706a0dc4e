"""`labelgen bcs-masks` on small clips with exact masks, and on the real videos."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from clips import CAMERA, SIZE, road_mask, vehicle_boxes, write_clip

from labelgen.datasets.scene import find_scene
from labelgen.geometry import Pair, Rectification, encode_boxes
from labelgen.labels import Flag, Split, VehicleClass
from labelgen.shards import ShardDataset, ShardReader, validate_shards


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips"))


def _hashes(folder: Path) -> list[str]:
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("shard-*.h5"))]


def _run(labelgen, out: Path, *arguments: object) -> dict:
    report = out.parent / f"{out.name}.json"
    done = labelgen("bcs-masks", *arguments, "--out", out, "--json", report)
    assert done.returncode == 0, done.stderr
    assert not any(validate_shards([out]).values())
    return json.loads(report.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize(("rule", "region"), [("wider", "road"), ("conditioned", "road"), ("wider", "frame")])
def test_labels_are_those_of_the_exact_boxes(
    labelgen, clip: Path, tmp_path: Path, pair: Pair, rule: str, region: str
) -> None:
    options = ["--masks", f"coco:{clip.parent / 'masks.json'}", "--every", 10, "--pair", pair, "--rule", rule]
    options += ["--region", region] if region != "road" else []
    report = _run(labelgen, tmp_path / "out", clip, *options)
    assert (report["images"], report["labels"], report["rejects"]) == (6, 12, 0)
    assert ShardDataset([tmp_path / "out"]).readers[0].settings["region"] == region
    size = (640, 360) if pair is Pair.VP2_VP3 else (360, 640)
    rectification = (
        Rectification.from_road_mask(CAMERA, road_mask(), pair, size)
        if region == "road"
        else Rectification.from_window(CAMERA, [0, 0, *SIZE], pair, size)
    )
    for sample in ShardDataset([tmp_path / "out"]):
        exact = encode_boxes(rectification.points(vehicle_boxes(sample.frame)), rectification.vpu)
        order = np.argsort(exact.boxes_xyxy[:, 0])
        found = np.argsort(sample.labels.boxes_xyxy[:, 0])
        uncut = ~sample.labels.has(Flag.TRUNCATED)[found]
        assert uncut.any()
        near = 2.5 if pair is Pair.VP2_VP3 else 5  # px: VP1-VP2 magnifies the far end of the road
        np.testing.assert_allclose(sample.labels.boxes_xyxy[found][uncut], exact.boxes_xyxy[order][uncut], atol=near)
        np.testing.assert_allclose(sample.labels.cc[found][uncut], exact.cc[order][uncut], atol=0.03)
        np.testing.assert_allclose(sample.rectification.matrix, rectification.matrix, atol=1e-12)
        assert sample.frame % 10 == 0
        assert sample.time_s == pytest.approx(sample.frame / 25)
        assert set(sample.labels.class_ids) == {VehicleClass.CAR}
        np.testing.assert_allclose(sample.labels.scores, 0.9)
        assert np.isfinite(sample.labels.candidates).all()
        np.testing.assert_array_equal(sample.window_xyxy, [0, 0, *SIZE])


def test_frames_that_are_not_rectified(labelgen, clip: Path, tmp_path: Path) -> None:
    masks = f"coco:{clip.parent / 'masks.json'}"
    options = ["--masks", masks, "--every", 10, "--region", "none", "--size", "320x180"]
    report = _run(labelgen, tmp_path / "out", clip, *options)
    assert (report["images"], report["labels"], report["rejects"]) == (6, 12, 0)
    for sample in ShardDataset([tmp_path / "out"]):
        assert sample.image.shape == (180, 320, 3)
        np.testing.assert_allclose(sample.rectification.matrix, np.diag([0.5, 0.5, 1]))
        corners = vehicle_boxes(sample.frame) / 2
        exact = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1).clip(0, [320, 180, 320, 180])
        found = sample.labels.boxes_xyxy
        np.testing.assert_allclose(found[found[:, 0].argsort()], exact[exact[:, 0].argsort()], atol=0.8)
        assert sample.labels.has(Flag.FLAT).all()
        assert not sample.labels.vertices(sample.rectification.vpu)[1].any()
    assert labelgen("inspect", tmp_path / "out").returncode == 0
    assert labelgen("bcs-masks", clip, "--masks", masks, "--region", "sky").returncode == 2


@pytest.mark.slow
def test_background_masks_find_the_cars(labelgen, tmp_path: Path) -> None:
    longer = write_clip(tmp_path, 200, coco=False)
    report = _run(labelgen, tmp_path / "out", longer, "--masks", "background", "--every", 10)
    assert report["labels"] >= 30  # of 40
    settings = ShardDataset([tmp_path / "out"]).readers[0].settings
    assert settings["masks"] == "background"


@pytest.mark.slow
def test_same_command_same_bytes(labelgen, clip: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        _run(labelgen, tmp_path / name, clip, "--masks", "background", "--every", 5, "--per-shard", 4)
    assert len(_hashes(tmp_path / "a")) == 3
    assert _hashes(tmp_path / "a") == _hashes(tmp_path / "b")


@pytest.mark.slow
@pytest.mark.parametrize("masks", ["background", "coco"])
def test_killed_at_any_moment_it_goes_on_and_ends_the_same(
    labelgen_process, clip: Path, tmp_path: Path, masks: str
) -> None:
    spec = masks if masks == "background" else f"coco:{clip.parent / 'masks.json'}"
    options = [clip, "--masks", spec, "--every", 1, "--per-shard", 6, "--keep-masks"]
    start = time.perf_counter()
    _run(labelgen_process, tmp_path / "whole", *options)
    whole = time.perf_counter() - start
    out = tmp_path / "out"
    command = [sys.executable, "-m", "labelgen", "bcs-masks", *options, "--out", out]
    rng = np.random.default_rng(2)
    for _ in range(5):
        process = subprocess.Popen([str(c) for c in command], stderr=subprocess.DEVNULL)
        try:
            process.wait(timeout=rng.uniform(0.4, 0.95) * whole)
            break
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        for path in out.glob("*.h5"):
            assert len(ShardReader(path)) <= 6
    if not (out / "dataset.json").exists():
        _run(labelgen_process, out, *options)
    assert _hashes(out) == _hashes(tmp_path / "whole")
    kept = "shard.masks.json"
    assert (out / kept).read_bytes() == (tmp_path / "whole" / kept).read_bytes()


@pytest.mark.slow
def test_several_videos_make_one_data_set_in_any_number_of_processes(labelgen, clip: Path, tmp_path: Path) -> None:
    other = write_clip(tmp_path / "two", 20, name="other.mp4")
    for workers in (1, 2):
        out = tmp_path / f"out{workers}"
        _run(labelgen, out, clip, other, "--masks", "background", "--every", 5, "--workers", workers)
        assert [path.name for path in sorted(out.glob("*.h5"))] == [
            "shard-000-clip-00000.h5",
            "shard-001-other-00000.h5",
        ]
    assert _hashes(tmp_path / "out1") == _hashes(tmp_path / "out2")


def test_default_output_is_named_after_the_input(labelgen, clip: Path, tmp_path: Path) -> None:
    done = labelgen("bcs-masks", clip, "--masks", f"coco:{clip.parent / 'masks.json'}", "--limit", 1)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "shards" / "clip" / "dataset.json").exists()


def test_session_folder_with_its_own_files_and_splits(labelgen, clip: Path, tmp_path: Path) -> None:
    session = tmp_path / "data" / "dataset" / "session2_left"
    results = tmp_path / "data" / "results" / "session2_left"
    session.mkdir(parents=True)
    results.mkdir(parents=True)
    shutil.copy(clip, session / "video.mp4")
    cv2.imwrite(str(session / "video_mask.png"), road_mask())
    (results / "system_optimal_calibration.json").write_text(json.dumps(CAMERA.to_dict()))
    report = _run(labelgen, tmp_path / "out", session, "--masks", f"coco:{clip.parent / 'masks.json'}", "--every", 20)
    assert report["images"] == 3
    sample = ShardDataset([tmp_path / "out"])[0]
    assert (sample.source, sample.camera.name, sample.split) == ("session2_left", "session2_left", Split.VALIDATION)
    scene = find_scene(session)
    assert scene.fps == 50
    assert [scene.split_of(n) for n in (0, 29_999, 30_000)] == [Split.VALIDATION, Split.VALIDATION, Split.TRAIN]


def test_folder_of_images(labelgen, clip: Path, tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    capture = cv2.VideoCapture(str(clip))
    for n in range(20):
        cv2.imwrite(str(folder / f"{n:04d}.png"), capture.read()[1])
    for suffix in ("calibration.json", "mask.png"):
        shutil.copy(clip.with_suffix(f".{suffix}"), tmp_path / f"frames.{suffix}")
    masks = f"coco:{clip.parent / 'masks.json'}"
    report = _run(labelgen, tmp_path / "out", folder, "--masks", masks, "--every", 5)
    assert (report["images"], report["labels"]) == (4, 8)


def test_a_truncated_video_is_read_and_reported(labelgen, clip: Path, tmp_path: Path) -> None:
    whole = write_clip(tmp_path, 60, name="cut.avi")
    data = whole.read_bytes()
    whole.write_bytes(data[: len(data) // 2])
    masks = f"coco:{clip.parent / 'masks.json'}"
    report = _run(labelgen, tmp_path / "out", whole, "--masks", masks, "--every", 5)
    assert 3 <= report["images"] < 12
    assert report["rejects_by_reason"]["input problem"] >= 1


def test_masks_that_give_no_label_are_listed(labelgen, clip: Path, tmp_path: Path) -> None:
    data = json.loads((clip.parent / "masks.json").read_text())
    first = [a for a in data["annotations"] if a["image_id"] == 0]
    for annotation, points in zip(
        first,
        ([[592, 4, 632, 4, 632, 34, 592, 34]], [[300, 200, 303, 200, 303, 203, 300, 203]]),
        strict=True,
    ):
        annotation["segmentation"] = points
    data["annotations"] = [a for a in data["annotations"] if a["image_id"] != 10]
    (tmp_path / "masks.json").write_text(json.dumps(data))
    report = _run(labelgen, tmp_path / "out", clip, "--masks", f"coco:{tmp_path / 'masks.json'}", "--every", 10)
    lines = [json.loads(line) for line in (tmp_path / "out" / "rejects.jsonl").read_text().splitlines()]
    reasons = {(line["frame"], line["item"]): line["reason"] for line in lines}
    assert reasons[(0, 1)] == "too small"
    assert reasons[(0, 0)] in ("off the road", "outside the rectified image")
    assert reasons[(0, -1)] == reasons[(10, -1)] == "frame without a labelled vehicle"
    assert report["images"] == 4


def test_touching_and_cut_vehicles_are_flagged(labelgen, clip: Path, tmp_path: Path) -> None:
    data = json.loads((clip.parent / "masks.json").read_text())
    data["annotations"] = [a for a in data["annotations"] if a["image_id"] == 20]
    x0, y0 = vehicle_boxes(20)[0].min(axis=0)
    x1, y1 = vehicle_boxes(20)[0].max(axis=0)
    for annotation, (left, right) in zip(data["annotations"], ((x0, x1), (x1, 2 * x1 - x0)), strict=True):
        annotation["segmentation"] = [[left, y0, right, y0, right, y1, left, y1]]
    (tmp_path / "masks.json").write_text(json.dumps(data))
    _run(labelgen, tmp_path / "out", clip, "--masks", f"coco:{tmp_path / 'masks.json'}", "--every", 20)
    labels = ShardDataset([tmp_path / "out"])[0].labels
    assert labels.has(Flag.TOUCHING).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "least"), [("city_road_640x360.mp4", 500), ("freeway_320x240.avi", 150)])
def test_real_videos_with_background_masks(labelgen, real_data: Path, tmp_path: Path, name: str, least: int) -> None:
    """A floor well under what was counted by eye, to notice when it breaks."""
    report = _run(labelgen, tmp_path / "out", real_data / "videos" / name, "--masks", "background", "--every", 10)
    assert report["labels"] >= least
    for sample in ShardDataset([tmp_path / "out"]):
        assert sample.vertices_px()[1].all()


def test_a_video_that_crashes_opencv_is_read(labelgen, real_data: Path, tmp_path: Path) -> None:
    odd = real_data / "videos" / "odd_rawvideo_48x48.avi"
    (tmp_path / "c.json").write_text(json.dumps(CAMERA.resized(48 / 640).to_dict()))
    mask = cv2.resize(road_mask(), (48, 48))
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    done = labelgen(
        "bcs-masks", odd, "--calibration", tmp_path / "c.json", "--road-mask", tmp_path / "m.png",
        "--masks", "background", "--every", 5, "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.returncode in (0, 2), (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr
    assert os.listdir(tmp_path)


def test_a_part_without_a_readable_frame_is_an_empty_shard(labelgen, clip: Path, tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    capture = cv2.VideoCapture(str(clip))
    for n in range(12):
        cv2.imwrite(str(folder / f"{n:04d}.png"), capture.read()[1])
    for n in range(4, 8):
        (folder / f"{n:04d}.png").write_bytes(b"damaged")
    scene = ("--calibration", clip.with_suffix(".calibration.json"), "--road-mask", clip.with_suffix(".mask.png"))
    masks = ("--masks", f"coco:{clip.parent / 'masks.json'}", "--every", 1, "--per-shard", 4)
    report = _run(labelgen, tmp_path / "out", folder, *scene, *masks)
    assert [len(ShardReader(path)) for path in sorted((tmp_path / "out").glob("*.h5"))] == [4, 0, 4]
    assert report["rejects_by_reason"]["input problem"] == 2
    rejects = (tmp_path / "out" / "rejects.jsonl").read_text()
    assert "4 images skipped: they cannot be read, such as 0004.png" in rejects
    assert "masks.json: 12 of 60 image entries used, 48 name no image of the folder" in rejects
