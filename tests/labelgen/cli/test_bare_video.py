"""A video with nothing beside it: rendered, calibrated, its road marked, labelled and measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labelgen.cli.main import main
from labelgen.geometry import Camera
from labelgen.synth.truth.session import write_session

pytestmark = pytest.mark.slow

SIZE = (640, 360)


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Camera, Path]:
    """A bare video, the camera it was rendered with, and its exact masks."""
    root = tmp_path_factory.mktemp("rendered")
    done = write_session(root, duration_s=32.0, fps=10.0, size_wh=SIZE, seed=7, per_minute=24.0)
    video = root / "bare.avi"
    video.write_bytes(Path(done.files["video"]).read_bytes())
    return video, Camera.load(done.files["calibration"], image_wh=SIZE), Path(done.files["masks"])


@pytest.mark.slow
def test_labels_and_speeds_from_a_bare_video(
    recording: tuple[Path, Camera, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, camera, masks = recording
    shards = tmp_path / "shards"
    label = ("bcs-masks", video, "--masks", f"coco:{masks}", "--every", 5, "--out", shards)
    assert run(*label) == 0
    said = capsys.readouterr().err
    assert "note: bare: no calibration and no road mask given; making them from the video itself" in said
    assert json.loads((shards / "dataset.json").read_text())["labels"] > 30
    made = json.loads((shards / "calibration.json").read_text())
    assert made["confidence"]["scale"]["method"] == "auto-models"
    found = Camera.load(shards / "calibration.json", image_wh=SIZE)
    directions = [np.array([*(c.vp1 - c.pp), c.focal]) for c in (camera, found)]
    cosine = directions[0] @ directions[1] / np.prod([np.linalg.norm(d) for d in directions])
    assert np.degrees(np.arccos(cosine)) < 1.5
    places = camera.project([[25.0, 0.0], [50.0, 0.0]])
    assert np.linalg.norm(np.diff(found.road_points(places), axis=0)) == pytest.approx(25.0, rel=0.1)

    # Once made, they are used again.
    assert run(*label, "--overwrite") == 0
    assert "of an earlier run" in capsys.readouterr().err
    out = tmp_path / "speeds"
    given = ("--calibration", shards / "calibration.json", "--road-mask", shards / "road_mask.png")
    assert (
        run("speed", video, "--from", f"masks:coco:{masks}", *given, "--out", out, "--json", tmp_path / "s.json") == 0
    )
    assert json.loads((tmp_path / "s.json").read_text())["vehicles"] > 10
    assert not (out / "bare" / "calibration.json").exists()


@pytest.mark.slow
def test_a_road_mask_by_its_own_command(recording: tuple[Path, Camera, Path], tmp_path: Path) -> None:
    video, camera, _ = recording
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    out = tmp_path / "mask.png"
    command = (
        "road-mask",
        video,
        "--calibration",
        tmp_path / "camera.json",
        "--out",
        out,
        "--json",
        tmp_path / "r.json",
    )
    assert run(*command) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["calibrated"], report["along"] > 0.9) == (False, True)
    assert (
        run(
            "rectify", video, "--calibration", tmp_path / "camera.json", "--road-mask", out, "--out", tmp_path / "p.png"
        )
        == 0
    )
