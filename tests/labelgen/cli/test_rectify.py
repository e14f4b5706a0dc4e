"""`labelgen rectify` on pictures, videos and sessions."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from clips import CAMERA, road_mask, write_clip

from labelgen.geometry import Pair, Rectification


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    clip = write_clip(folder, 6)
    picture = np.zeros((360, 640, 3), np.uint8)
    picture[road_mask() > 0] = (40, 160, 90)
    cv2.imwrite(str(folder / "still.png"), picture)
    for suffix in ("calibration.json", "mask.png"):
        (folder / f"still.{suffix}").write_bytes(clip.with_suffix(f".{suffix}").read_bytes())
    return folder


@pytest.mark.parametrize("source", ["clip.mp4", "still.png"])
@pytest.mark.parametrize("pair", list(Pair))
def test_picture_and_numbers(labelgen, scene: Path, tmp_path: Path, source: str, pair: Pair) -> None:
    done = labelgen("rectify", scene / source, "--pair", pair, "--out", "p.png", "--json", "n.json")
    assert done.returncode == 0, done.stderr
    numbers = json.loads((tmp_path / "n.json").read_text())
    size = (640, 360) if pair is Pair.VP2_VP3 else (360, 640)
    wanted = Rectification.from_road_mask(CAMERA, road_mask(), pair, size)
    np.testing.assert_allclose(numbers["matrix"], wanted.matrix, rtol=1e-9)
    np.testing.assert_allclose(numbers["vpu"], wanted.vpu, rtol=1e-9)
    assert numbers["frame_coverage"] == pytest.approx(wanted.frame_coverage)
    assert numbers["road_area"] == pytest.approx(wanted.road_area)
    assert numbers["size"] == list(size)
    picture = cv2.imread(str(tmp_path / "p.png"))
    assert picture.shape[1::-1] == size
    if source == "still.png":
        painted = cv2.imread(str(scene / source))
        np.testing.assert_array_equal(picture, wanted.warp_image(painted))


def test_it_does_not_overwrite_unasked(labelgen, scene: Path, tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"mine")
    done = labelgen("rectify", scene / "still.png", "--out", "p.png")
    assert done.returncode == 2
    assert "it exists; add --overwrite" in done.stderr
    assert (tmp_path / "p.png").read_bytes() == b"mine"
    assert labelgen("rectify", scene / "still.png", "--out", "p.png", "--overwrite").returncode == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cover", "sky"), "'sky' is not one of 'frame', 'mask'"),
        (("--frame", "999"), "it has no frame 999"),
        (("--out", "p.gif"), "name a .png or .jpg file"),
    ],
)
def test_refusals(labelgen, scene: Path, options, message: str) -> None:
    done = labelgen("rectify", scene / "clip.mp4", *(() if "--out" in options else ("--out", "p.png")), *options)
    assert done.returncode == 2
    assert message in done.stderr


def test_a_mask_that_leaves_the_frame_uncovered_can_fail_clearly(labelgen, scene: Path) -> None:
    """The text's own rule: most VP2-VP3 scenes never have 80 % of the picture inside the mask."""
    done = labelgen("rectify", scene / "still.png", "--out", "p.png", "--cover", "mask")
    assert done.returncode == 2
    assert "cropped away before 80% of the VP2-VP3 output lay inside the mask" in done.stderr


def test_real_sessions_rectify_from_their_empty_road(labelgen, real_data: Path, tmp_path: Path) -> None:
    session = real_data / "brnocompspeed" / "dataset" / "session5_left"
    done = labelgen("rectify", session, "--out", "p.png", "--json", "n.json")
    assert done.returncode == 0, done.stderr
    numbers = json.loads((tmp_path / "n.json").read_text())
    # real/expected/rectifications.json: crop_steps 86, frame coverage 0.824, road area 0.329.
    assert numbers["crop_steps"] == 86
    assert numbers["frame_coverage"] == pytest.approx(0.824, abs=0.01)
    assert numbers["road_area"] == pytest.approx(0.329, abs=0.01)
