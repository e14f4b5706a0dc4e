"""What is refused: one clear line, exit code 2, nothing run, nothing half-written."""

from __future__ import annotations

import json
import os
import pickle
import resource
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from boxcars_trees import write_tree
from clips import CAMERA, road_mask, write_clip

REPOSITORY = Path(__file__).resolve().parents[3]


def _refused(done: subprocess.CompletedProcess[str], *parts: str) -> str:
    assert done.returncode == 2, (done.returncode, done.stderr)
    lines = [line for line in done.stderr.splitlines() if line.startswith("labelgen: error: ")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for part in parts:
        assert part in lines[0], lines[0]
    return lines[0]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip"), 10)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tree") / "BoxCars116k"
    write_tree(root, vehicles=3)
    return root


def test_missing_root_says_what_to_set(labelgen, tmp_path: Path) -> None:
    done = labelgen("boxcars", "--out", tmp_path / "out", HOME=str(tmp_path), LABELGEN_BOXCARS116K="")
    _refused(done, "BoxCars116k not found", "give its folder", "LABELGEN_BOXCARS116K=DIR", "labelgen synth boxcars")
    _refused(labelgen("boxcars", "--root", "nowhere", "--out", "out"), "root nowhere: no such folder")
    done = labelgen("boxcars", "--out", "out", LABELGEN_BOXCARS116K="elsewhere")
    _refused(done, "LABELGEN_BOXCARS116K=elsewhere: no such folder")
    assert not (tmp_path / "out").exists()


def test_root_from_the_environment(labelgen, tree: Path) -> None:
    assert labelgen("boxcars", "--out", "out", LABELGEN_BOXCARS116K=str(tree)).returncode == 0


def test_wrong_layout(labelgen, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    message = _refused(labelgen("boxcars", "--root", "empty", "--out", "out"), "not a BoxCars116k tree")
    assert "dataset.pkl nor json_data/dataset.json" in message
    (tmp_path / "empty" / "dataset.pkl").write_bytes(pickle.dumps({"cameras": {}, "samples": []}))
    _refused(labelgen("boxcars", "--root", "empty", "--out", "out"), "no pictures, neither images/ nor atlas.pkl")


class _Payload:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


@pytest.mark.parametrize("name", ["dataset.pkl", "atlas.pkl", "classification_splits.pkl"])
def test_malicious_pickles_do_not_run(labelgen, tmp_path: Path, name: str) -> None:
    write_tree(tmp_path / "tree", vehicles=3, images=False)
    marker = tmp_path / "payload-ran"
    (tmp_path / "tree" / name).write_bytes(pickle.dumps({"cameras": _Payload(marker)}))
    done = labelgen("boxcars", "--root", "tree", "--out", "out", "--cameras", "all", "--all-directions")
    _refused(done, name, "refused, nothing was run: it asks for", "system")
    assert not marker.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "no camera in it"),
        ("[]", "no camera in it"),
        ('{"camera_calibration": {"vp1": [1, 2], "pp": [0, 0]}}', "missing vp2"),
        ("not json", "not JSON"),
        ('{"camera_calibration": {"vp1": [1, 2], "vp2": [1, 2], "pp": [0, 0]}}', "cannot be orthogonal"),
        ('{"camera_calibration": {"vp1": [1, NaN], "vp2": [1, 2], "pp": [0, 0]}}', "vp1: expected two finite"),
        ('{"camera_calibration": {"vp1": [1, 2], "vp2": [-900, 2], "pp": [0, 0], "scale": -1}}', "scale: expected"),
    ],
)
def test_calibrations_without_a_camera(labelgen, clip: Path, tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "c.json").write_text(content)
    done = labelgen("bcs-masks", clip, "--calibration", "c.json", "--masks", "background", "--out", "out")
    _refused(done, "c.json", message)
    assert not (tmp_path / "out").exists()


def _masks() -> dict[str, tuple[np.ndarray, str]]:
    top = np.zeros((360, 640), np.uint8)
    top[40:, :] = 255
    dot = np.zeros((360, 640), np.uint8)
    dot[10:350, 20:600] = 255
    return {
        "another ratio": (road_mask()[:180, :480], "it is 480x180 px, but the frames are 640x360"),
        "empty": (np.zeros((360, 640), np.uint8), "it is empty"),
    }


@pytest.mark.parametrize("case", list(_masks()))
def test_road_masks_that_cannot_be(labelgen, clip: Path, tmp_path: Path, case: str) -> None:
    mask, message = _masks()[case]
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    done = labelgen("bcs-masks", clip, "--road-mask", "m.png", "--masks", "background", "--out", "out")
    _refused(done, "road mask", message)
    assert not (tmp_path / "out").exists()


def test_vanishing_point_inside_the_mask(labelgen, clip: Path, tmp_path: Path) -> None:
    calibration = CAMERA.to_dict()
    calibration["camera_calibration"].update(vp1=[320.0, 90.0], vp2=[9000.0, 95.0], pp=[330.0, 180.0])
    (tmp_path / "c.json").write_text(json.dumps(calibration))
    mask = np.zeros((360, 640), np.uint8)
    mask[60:350, 100:600] = 255
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    done = labelgen(
        "rectify", clip, "--calibration", "c.json", "--road-mask", "m.png", "--pair", "VP1-VP2", "--out", "p.png"
    )
    _refused(done, "VP1 at (320, 90) lies inside the road mask's hull")
    assert not (tmp_path / "p.png").exists()


def test_what_is_missing_beside_a_video_is_made_or_refused(labelgen, clip: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.mp4"
    bare.write_bytes(clip.read_bytes())
    done = labelgen("bcs-masks", bare, "--masks", "background", "--out", "shards")
    assert done.returncode == 2
    assert "note: bare: no calibration and no road mask given; making them from the video itself" in done.stderr
    assert [line for line in done.stderr.splitlines() if line.startswith("labelgen: error: bare: ")]
    assert not (tmp_path / "shards").exists()


def test_what_was_given_and_is_not_there_is_named(labelgen, clip: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.mp4"
    bare.write_bytes(clip.read_bytes())
    _refused(
        labelgen("bcs-masks", bare, "--calibration", "c.json", "--road-mask", "m.png", "--masks", "background"),
        "bare.mp4", "no calibration at c.json; no road mask at m.png (options --calibration, --road-mask)",
    )  # fmt: skip


@pytest.mark.parametrize("content", [b"", b"this is no video\n" * 100])
def test_files_that_are_no_video(labelgen, clip: Path, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mp4").write_bytes(content)
    done = labelgen(
        "bcs-masks", "x.mp4", "--calibration", clip.with_suffix(".calibration.json"),
        "--road-mask", clip.with_suffix(".mask.png"), "--masks", "background",
    )  # fmt: skip
    _refused(done, "x.mp4")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("boxcars", "--pair", "VP1-VP3"), "'VP1-VP3' is not one of"),
        (("boxcars", "--size", "320"), "unknown size; write WIDTHxHEIGHT"),
        (("boxcars", "--size", "0x0"), "unknown size"),
        (("boxcars", "--cameras", "nobody"), "--cameras nobody: not in the data set; it has alpha, beta, uvoz"),
        (("boxcars", "--split", "odd"), "--split odd"),
        (("boxcars", "--quality", "300"), "expected 1 to 100"),
        (("boxcars", "--limit", "0"), "--limit"),
        (("boxcars", "--nonsense"), "No such option"),
    ],
)
def test_options_of_boxcars(labelgen, tree: Path, tmp_path: Path, arguments, message: str) -> None:
    _refused(labelgen(*arguments, "--root", tree, "--out", "out"), message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--masks", "magic"), "use one of maskrcnn, background, coco:FILE"),
        (("--masks", "coco:none.json"), "none.json"),
        (("--masks", "background", "--rule", "best"), "'best' is not one of 'wider', 'conditioned'"),
        (("--masks", "background", "--pair", "VP1"), "'VP1' is not one of"),
        (("--masks", "background", "--size", "big"), "unknown size"),
        (("--masks", "maskrcnn", "--weights", "none.pth"), "none.pth"),
    ],
)
def test_options_of_bcs_masks(labelgen, clip: Path, tmp_path: Path, arguments, message: str) -> None:
    _refused(labelgen("bcs-masks", clip, *arguments, "--out", "out"), message)
    assert not (tmp_path / "out").exists()


def test_weights_that_cannot_be_downloaded(labelgen, clip: Path, tmp_path: Path) -> None:
    """A proxy that refuses stands for a machine without a connection."""
    proxies = dict.fromkeys(("http_proxy", "https_proxy", "HTTPS_PROXY", "HTTP_PROXY"), "http://127.0.0.1:9")
    done = labelgen("bcs-masks", clip, "--out", "out", TORCH_HOME=str(tmp_path / "torch"), **proxies)
    command = f"labelgen bcs-masks {clip} --out out --masks"
    _refused(done, "as weights", f": {command} onnx:yolo11n-seg.onnx; or: {command} background")
    given = ("speed", clip, "--out", "out", "--from=masks:maskrcnn")
    done = labelgen(*given, TORCH_HOME=str(tmp_path / "torch"), **proxies)
    _refused(done, f"; or: labelgen speed {clip} --out out --from masks:background")
    assert not (tmp_path / "out").exists()


def test_zero_vehicles(labelgen, tmp_path: Path) -> None:
    empty = write_clip(tmp_path, 10, name="empty.mp4", cars=False)
    done = labelgen("bcs-masks", empty, "--masks", "coco:masks.json", "--out", "out", "--every", 2)
    _refused(done, "no vehicles found", "5 x frame without a labelled vehicle", "nothing was written")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_output(labelgen, tree: Path, tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    _refused(labelgen("boxcars", "--root", tree, "--out", locked / "out"), "cannot write", "permission denied")


def test_output_below_a_file(labelgen, tree: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    _refused(labelgen("boxcars", "--root", tree, "--out", "file"), "--out file: a file of that name is in the way")
    _refused(labelgen("boxcars", "--root", tree, "--out", "file/out"), "cannot write file/out")
    assert (tmp_path / "file").read_text() == "mine"


def test_full_output(tmp_path: Path, tree: Path) -> None:
    """A limit on the size of files stands for a full disk: the shard does not fit, nothing of it stays."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    done = subprocess.run(
        [sys.executable, "-m", "labelgen", "boxcars", "--root", str(tree), "--out", "out",
         "--cameras", "all", "--workers", "1"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, preexec_fn=limit, capture_output=True,
        text=True,
    )  # fmt: skip
    _refused(done, "cannot write", "shard-00000.h5", "too large")
    assert not list((tmp_path / "out").rglob("*.h5"))
    assert not list((tmp_path / "out").rglob("*.tmp"))


def test_shards_that_are_none(labelgen, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "x.h5").write_bytes(b"nothing")
    for command in (("inspect",), ("validate",), ("merge", "--out", "m"), ("audit", "--out", "a")):
        _refused(labelgen(*command, "empty"), "no shards in it")
        _refused(labelgen(*command, "none"), "no such file or folder")
    _refused(labelgen("inspect", "x.h5"), "not a whole HDF5 file")
    done = labelgen("validate", "x.h5")
    assert done.returncode == 2
    assert "x.h5: " in done.stderr
    assert "Traceback" not in done.stderr


def test_help_of_every_command_reads(labelgen) -> None:
    done = labelgen("--help")
    assert done.returncode == 0
    commands = [line.split()[0] for line in done.stdout.split("Commands:")[1].splitlines() if line.strip()]
    assert {"boxcars", "bcs-masks", "rectify", "inspect", "validate", "merge", "audit"} <= set(commands)
    for command in commands:
        page = labelgen(command, "--help")
        assert page.returncode == 0
        assert "Usage: labelgen" in page.stdout
