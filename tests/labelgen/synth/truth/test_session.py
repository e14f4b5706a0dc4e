"""Synthetic sessions, through the command line: the files, the truth, and that both agree."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from pycocotools import mask as coco
from typer.testing import CliRunner

from labelgen.cli.synth import synth_app
from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Pair, Rectification, RoadMask, road_cuboids
from tools.studies.check_truth import check_session

pytestmark = pytest.mark.slow

SMALL = ["--size", "480x270", "--fps", "5", "--duration", "4", "--seed", "4"]
NAME = "session0_center"


def run(*arguments: str) -> None:
    result = CliRunner().invoke(synth_app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output


def frames_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="bgr24") for f in container.decode(video=0)]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("session")
    run("session", "--out", str(out), *SMALL)
    return out


@pytest.fixture(scope="module")
def boxes(root: Path) -> list[dict]:
    text = (root / "truth" / NAME / "boxes.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()]


def test_layout_is_that_of_brnocompspeed(root: Path) -> None:
    dataset = root / "dataset" / NAME
    assert {p.name for p in dataset.iterdir()} == {"video.avi", "video_mask.png", "screen.png", "gt_data.pkl"}
    assert cv2.imread(str(dataset / "screen.png")).shape == (270, 480, 3)
    camera = Camera.load(root / "results" / NAME / "system_optimal_calibration.json", image_wh=(480, 270))
    assert 4 < camera.height_m < 13
    mask = RoadMask(cv2.imread(str(dataset / "video_mask.png"), cv2.IMREAD_GRAYSCALE))
    for pair, size in ((Pair.VP2_VP3, (480, 270)), (Pair.VP1_VP2, (270, 480))):
        assert Rectification.from_road_mask(camera, mask, pair, size).frame_coverage > 0.5
    gt = load_pickle(dataset / "gt_data.pkl")
    assert set(gt) >= {"fps", "cars", "measurementLines", "laneDivLines", "invalidLanes", "distanceMeasurement"}
    assert len(frames_of(dataset / "video.avi")) == 20


def test_surveyed_distances_are_those_of_the_calibration(root: Path) -> None:
    camera = Camera.load(root / "results" / NAME / "system_truth.json")
    for segment in load_pickle(root / "dataset" / NAME / "gt_data.pkl")["distanceMeasurement"]:
        ends = camera.road_points(np.stack([segment["p1"][:2], segment["p2"][:2]]))
        assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(segment["distance"], abs=1e-6)


def test_boxes_are_the_projection_of_cuboids_on_the_road(root: Path, boxes: list[dict]) -> None:
    camera = Camera.load(root / "results" / NAME / "system_truth.json")
    vehicles = [v for frame in boxes for v in frame["vehicles"]]
    assert len(vehicles) > 20
    for vehicle in vehicles:
        world = road_cuboids([vehicle["near_xy_m"]], [vehicle["size_lwh_m"]])[0]
        np.testing.assert_allclose(world, vehicle["vertices_m"], atol=1e-4)
        np.testing.assert_allclose(camera.project(world), vehicle["vertices_px"], atol=0.02)


def test_speeds_are_the_distance_between_frames(boxes: list[dict]) -> None:
    places: dict[int, list[tuple[int, float, float]]] = {}
    for frame in boxes:
        for v in frame["vehicles"]:
            places.setdefault(v["track_id"], []).append((frame["frame"], v["near_xy_m"][0], v["speed_kmh"]))
    checked = 0
    for seen in places.values():
        for (f0, x0, speed), (f1, x1, _) in pairwise(seen):
            assert abs(x1 - x0) * 5 / (f1 - f0) * 3.6 == pytest.approx(speed, rel=1e-4)
            checked += 1
    assert checked > 10


def test_masks_boxes_and_meshes_agree(root: Path) -> None:
    found = check_session(root / "dataset" / NAME)
    assert len(found["kind"]) > 5
    assert (found["inside"] >= 0.995).all()
    assert (found["outline"] <= 2).all()


def test_cuboid_vehicles_fill_their_boxes(tmp_path: Path) -> None:
    run("session", "--out", str(tmp_path), *SMALL, "--bodies", "box")
    found = check_session(tmp_path / "dataset" / NAME)
    assert len(found["kind"]) > 5
    assert (found["inside"] >= 0.995).all()
    assert (found["sides"] <= 2).all()


def test_masks_do_not_overlap_and_show_in_the_picture(root: Path) -> None:
    data = json.loads((root / "truth" / NAME / "masks.json").read_text(encoding="utf-8"))
    assert [image["frame"] for image in data["images"]] == list(range(20))
    pictures = frames_of(root / "dataset" / NAME / "video.avi")
    empty = cv2.imread(str(root / "dataset" / NAME / "screen.png")).astype(int)
    for image in data["images"]:
        here = [a for a in data["annotations"] if a["image_id"] == image["id"]]
        masks = [coco.decode(a["segmentation"]).astype(bool) for a in here]
        for annotation, mask in zip(here, masks, strict=True):
            x, y, w, h = annotation["bbox"]
            assert mask.sum() == annotation["area"] == mask[y : y + h, x : x + w].sum()
        if not masks:
            continue
        assert np.sum(masks, axis=0).max() == 1
        change = np.abs(pictures[image["id"]].astype(int) - empty).max(axis=2)
        both = np.any(masks, axis=0)
        assert np.median(change[both]) > 3 * np.median(change[~both])


def test_same_seed_same_bytes_and_frames(root: Path, tmp_path: Path) -> None:
    run("session", "--out", str(tmp_path), *SMALL)
    files = sorted(p.relative_to(root) for p in root.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    for name in files:
        if name.suffix != ".avi":
            assert (root / name).read_bytes() == (tmp_path / name).read_bytes(), name
    video = Path("dataset") / NAME / "video.avi"
    for a, b in zip(frames_of(root / video), frames_of(tmp_path / video), strict=True):
        assert np.array_equal(a, b)


def test_tracks_without_video_are_those_with_it(root: Path, tmp_path: Path, boxes: list[dict]) -> None:
    run("session", "--out", str(tmp_path), *SMALL, "--no-video")
    lines = (tmp_path / "truth" / NAME / "boxes.jsonl").read_text(encoding="utf-8").splitlines()
    for line, frame in zip(lines, boxes, strict=True):
        there = {v["track_id"]: v for v in json.loads(line)["vehicles"]}
        for vehicle in frame["vehicles"]:
            assert there[vehicle["track_id"]]["vertices_px"] == vehicle["vertices_px"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--replay"], "name a real session"),
        (["--bodies", "tank"], "supermini"),
        (["--size", "65x36"], "even"),
        (["--scene", "no/such/session"], "no such"),
    ],
)
def test_bad_options_say_what_helps(arguments: list[str], says: str, tmp_path: Path) -> None:
    options = ["session", "--out", str(tmp_path), "--duration", "1", *arguments]
    with pytest.raises(LabelgenError, match=says) as caught:
        CliRunner().invoke(synth_app, options, catch_exceptions=False)
    assert "\n" not in str(caught.value)


def test_nothing_is_replaced_unasked(root: Path) -> None:
    with pytest.raises(LabelgenError, match="it exists already"):
        run("session", "--out", str(root), *SMALL, "--size", "64x36")


def test_an_interrupted_session_is_a_shorter_one(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "labelgen", "synth", "session"]
    command += ["--out", str(tmp_path), "--size", "320x180", "--duration", "200", "--seed", "4"]
    boxes_file = tmp_path / "truth" / NAME / "boxes.jsonl"
    growing = tmp_path / f".labelgen-synth-{NAME}" / "truth" / NAME / "boxes.jsonl"
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not growing.exists() or not growing.stat().st_size:
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=120)
    assert process.returncode == 130
    count = len(frames_of(tmp_path / "dataset" / NAME / "video.avi"))
    assert 0 < count < 5000
    assert len(boxes_file.read_text(encoding="utf-8").splitlines()) == count
    masks = json.loads((tmp_path / "truth" / NAME / "masks.json").read_text(encoding="utf-8"))
    assert len(masks["images"]) == count
    assert load_pickle(tmp_path / "dataset" / NAME / "gt_data.pkl")["fps"] == 25
