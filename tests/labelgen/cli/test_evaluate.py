"""`labelgen evaluate` on made-up recordings in the public layout."""

from __future__ import annotations

import csv
import io
import json
import os
import pickle
import re
from pathlib import Path
from typing import Any

import pytest

from labelgen.cli.main import main
from labelgen.geometry import Camera
from tools.benchmarks.score import synthetic_recording

KEYS = {
    "recording", "tracks", "calibration", "n", "mean", "median", "p95", "worst", "mean_relative", "median_relative",
    "p95_relative", "recall", "precision", "false_positives", "matched", "intersection_failures",
    "calibration_ratio_error_relative_mean", "calibration_ratio_error_absolute_mean", "distance_error_m_mean",
    "distance_error_relative_mean",
}  # fmt: skip


def write(root: Path, name: str, seed: int, systems: dict[str, slice]) -> None:
    """A recording of 12 cars, of which each system tracked a part."""
    recording = synthetic_recording(12, seed)
    for folder in (root / "dataset" / name, root / "results" / name):
        folder.mkdir(parents=True)
    with (root / "dataset" / name / "gt_data.pkl").open("wb") as file:
        pickle.dump(recording.truth, file, protocol=2)
    for system, part in systems.items():
        results = recording.results | {"cars": recording.results["cars"][part]}
        (root / "results" / name / f"system_{system}.json").write_text(json.dumps(results))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    both = {"front": slice(0, 9), "back": slice(4, 12)}
    write(tmp_path, "session1_left", 1, both)
    write(tmp_path, "session4_right", 2, both)
    write(tmp_path, "session4_center", 3, {"front": slice(0, 9)})
    camera = Camera.load(tmp_path / "results/session1_left/system_front.json")
    larger = Camera(camera.vp1, camera.vp2, camera.pp, camera.scale * 1.1)
    for name in ("session1_left", "session4_right"):
        (tmp_path / "results" / name / "system_larger.json").write_text(json.dumps(larger.to_dict()))
    return tmp_path


def run(root: Path, *arguments: str) -> int:
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--dataset", str(root / "dataset"), "--results", str(root / "results"), *arguments])
    return int(stop.value.code or 0)


def report(root: Path, *arguments: str) -> dict[str, Any]:
    assert run(root, *arguments, "--json", str(root / "out.json")) == 0
    return json.loads((root / "out.json").read_text())


def test_rows_and_pooled(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = report(root, "--system", "front", "--recordings", "session1_left,session4_right")
    assert [row["recording"] for row in data["rows"]] == ["session1_left", "session4_right"]
    assert all(set(row) == KEYS for row in data["rows"])
    assert [row["n"] for row in data["rows"]] == [9, 9]
    assert data["rows"][0]["tracks"] == "system_front.json"
    assert data["rows"][0]["calibration"] == "own"
    assert data["pooled"]["front"]["n"] == 18
    assert data["pooled"]["front"]["recall"] == 0.75
    assert data["pooled"]["front"]["mean"] < 1.0
    out = capsys.readouterr().out
    assert "session1_left" in out
    assert "pooled" in out
    assert "front: 18 tracks read, 0 left out" in out


@pytest.mark.parametrize(
    "systems",
    [
        ["--system", "front", "--system", "back"],
        ["--system", "front", "back"],
        ["--system", "front,back"],
        ["--system", "system_front.json", "--system", "back", "--system", "front"],
    ],
)
def test_several_systems_however_they_are_named(root: Path, systems: list[str]) -> None:
    data = report(root, "--recordings", "session1_left", *systems)
    assert data["systems"] == ["front", "back"]
    assert [row["tracks"] for row in data["rows"]] == ["system_front.json", "system_back.json"]


def test_common_recall_leaves_the_vehicles_all_found(root: Path) -> None:
    data = report(root, "--system", "front", "back", "--recordings", "session1_left", "--common-recall")
    assert [row["n"] for row in data["rows"]] == [5, 5]
    assert [row["recall"] for row in data["rows"]] == [9 / 12, 8 / 12]
    assert data["rows"][0]["mean"] == pytest.approx(data["rows"][1]["mean"])


def test_another_systems_calibration(root: Path) -> None:
    own = report(root, "--system", "front", "--recordings", "session1_left")["rows"][0]
    other = report(root, "--system", "front", "--recordings", "session1_left", "--calibration", "larger")["rows"][0]
    assert other["calibration"] == "system_larger.json"
    assert (other["matched"], other["recall"]) == (own["matched"], own["recall"])
    assert other["mean_relative"] == pytest.approx(10, abs=1)


def test_split_c_takes_its_test_recordings_and_names_those_missing(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = report(root, "--system", "front")
    assert data["recordings"] == ["session4_center", "session4_right"]
    note = capsys.readouterr().err
    assert "session6_left" in note
    assert "session4_right" not in note


def test_all_recordings_in_their_natural_order(root: Path) -> None:
    data = report(root, "--system", "front", "--recordings", "all")
    assert data["recordings"] == ["session1_left", "session4_center", "session4_right"]


def test_empty_results_have_a_row(root: Path) -> None:
    path = root / "results/session1_left/system_front.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"cars": []}))
    row = report(root, "--system", "front", "--recordings", "session1_left")["rows"][0]
    assert (row["n"], row["recall"], row["false_positives"], row["mean"]) == (0, 0.0, 0, None)


def test_plots_and_tables(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ["--system", "front", "back", "--recordings", "session1_left"]
    assert run(root, *names, "--plots", str(root / "plots" / "here"), "--format", "csv") == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["recording"] for row in rows] == ["session1_left", "session1_left", "pooled", "pooled"]
    assert {path.name for path in (root / "plots/here").iterdir()} == {
        "cumulative_absolute.png",
        "cumulative_relative.png",
    }
    assert run(root, *names, "--format", "markdown") == 0
    assert capsys.readouterr().out.startswith("| system")


class Payload:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self.marker),))


def break_truth(root: Path) -> None:
    (root / "dataset/session1_left/gt_data.pkl").write_bytes(pickle.dumps(Payload(root / "ran"), protocol=2))


def break_results(root: Path) -> None:
    (root / "results/session1_left/system_front.json").write_bytes(b"")


def break_cars(root: Path) -> None:
    (root / "results/session1_left/system_front.json").write_text('{"camera_calibration": {}}')


def break_calibration(root: Path) -> None:
    path = root / "results/session1_left/system_front.json"
    data = json.loads(path.read_text())
    del data["camera_calibration"]["vp1"]
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("damage", "arguments", "message"),
    [
        (break_truth, [], "refused"),
        (break_results, [], "not JSON"),
        (break_cars, [], "'cars'"),
        (break_calibration, [], "vp1"),
        (None, ["--system", "nobody"], r"system_nobody\.json: no such file"),
        (None, ["--system", "back", "--recordings", "all"], "all are there for .*session1_left,session4_right"),
        (None, ["--recordings", "session9_left"], "no recording session9_left.*session1_left"),
        (None, ["--recordings", ","], "no recording"),
        (None, ["--calibration", "nobody"], r"system_nobody\.json: no such file"),
        (None, ["--format", "html"], "'html' is not one of 'text', 'markdown', 'csv'"),
        (None, ["--json", "/proc/nowhere/out.json"], "its folder is missing or cannot be written"),
    ],
)
def test_what_cannot_be_scored_is_one_line(
    root: Path, capsys: pytest.CaptureFixture[str], damage: Any, arguments: list[str], message: str
) -> None:
    if damage is not None:
        damage(root)
    given = ["--system", "front", "--recordings", "session1_left"]
    assert run(root, *given, *arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("labelgen: error:")]
    assert len(lines) == 1
    assert re.search(message, lines[0])
    assert not (root / "ran").exists()


@pytest.mark.parametrize(
    ("dataset", "results", "message"),
    [
        ("nowhere", "results", "no such folder"),
        ("results", "results", "no folder with a gt_data.pkl"),
        (".", "results", "did you mean"),
        ("dataset", "nowhere", "no such folder"),
    ],
)
def test_wrong_folders_are_one_line(
    root: Path, capsys: pytest.CaptureFixture[str], dataset: str, results: str, message: str
) -> None:
    arguments = ["--dataset", str(root / dataset), "--results", str(root / results), "--system", "front"]
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", *arguments])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_every_car_read_is_accounted_for(root: Path) -> None:
    path = root / "results/session1_left/system_front.json"
    data = json.loads(path.read_text())
    data["cars"][0]["posX"] = 512.0
    data["cars"][1] |= {key: data["cars"][1][key][:5] for key in ("posX", "posY", "frames")}
    data["cars"][2]["contours"] = [[1, 2], [3, 4]]
    path.write_text(json.dumps(data))
    (losses,) = report(root, "--system", "front", "--recordings", "session1_left")["tracks"]
    assert (losses["read"], losses["dropped"]) == (9, {"without lists": 1, "too few points": 1})
