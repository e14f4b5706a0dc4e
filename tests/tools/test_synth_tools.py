"""The tools around synthetic traffic: drawing the truth, lookalike sheets, the benchmark, label errors."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from labelgen.errors import DataError
from labelgen.geometry import Rule
from labelgen.synth.scenes import procedural_scene
from labelgen.synth.session import write_session
from tools import benchmark_render, draw_truth, label_truth, lookalike_sheet, lookalike_table, lookalike_video

NAME = "session0_center"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tools")
    write_session(out, duration_s=16, fps=5, size_wh=(640, 360), seed=4)
    return out / "dataset" / NAME


def run(function: object, *arguments: str) -> None:
    app = typer.Typer()
    app.command()(function)  # type: ignore[type-var]
    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output


def test_the_truth_is_drawn_where_vehicles_are(session: Path, tmp_path: Path) -> None:
    lines = (session.parent.parent / "truth" / NAME / "boxes.jsonl").read_text(encoding="utf-8").splitlines()
    busy = max((json.loads(line) for line in lines), key=lambda f: len(f["vehicles"]))
    run(draw_truth.main, str(session), "--out", str(tmp_path / "truth.png"), "--frame", str(busy["frame"]))
    picture = cv2.imread(str(tmp_path / "truth.png"))
    red = (picture[..., 2] > 200) & (picture[..., :2].max(axis=2) < 90)
    assert red.sum() > 20 * len(busy["vehicles"])


def test_drawing_needs_a_truth(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="labelgen synth session"):
        run(draw_truth.main, str(tmp_path / "dataset" / "x"), "--out", str(tmp_path / "y.png"))


def test_a_lookalike_sheet_tells_nothing_but_the_key_does(session: Path, tmp_path: Path) -> None:
    video, sheet, key = str(session / "video.avi"), tmp_path / "sheet.png", tmp_path / "key.json"
    options = ["--out", str(sheet), "--key", str(key), "--count", "2", "--min-px", "16"]
    run(lookalike_sheet.main, video, video, *options)
    answer = json.loads(key.read_text(encoding="utf-8"))
    assert sorted(answer.values()) == ["real", "real", "synthetic", "synthetic"]
    assert cv2.imread(str(sheet)).shape == (300, 1500, 3)


def test_too_few_vehicles_for_a_sheet(session: Path) -> None:
    with pytest.raises(DataError, match="--min-px"):
        lookalike_sheet.vehicle_crops(session / "video.avi", 5, 0, 350)


def test_a_sheet_shows_different_vehicles_first(session: Path) -> None:
    crops = lookalike_sheet.vehicle_crops(session / "video.avi", 3, 0, 16)
    small = [cv2.resize(c, (8, 8), interpolation=cv2.INTER_AREA).astype(float) for c in crops]
    assert min(np.abs(small[a] - small[b]).mean() for a, b in ((0, 1), (0, 2), (1, 2))) > 8


def test_the_table_tells_apart_what_differs_and_nothing_else(session: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    flat = [rng.normal(100, 10, (40, 40, 3)).clip(0, 255).astype(np.uint8) for _ in range(16)]
    busy = [rng.normal(100, 40, (40, 40, 3)).clip(0, 255).astype(np.uint8) for _ in range(8)]
    rows = {name: (a, b, more) for name, a, b, more in lookalike_table.compare(flat[:8], busy)}
    assert rows["contrast"][0] < rows["contrast"][1]
    assert rows["contrast"][2] == 1
    assert rows["width px"][2] == 0.5
    assert lookalike_table.told_apart(flat[:8], busy) == 1
    assert lookalike_table.told_apart(flat[:8], flat[8:]) < 0.85
    video, out = str(session / "video.avi"), tmp_path / "table.json"
    run(lookalike_table.main, video, video, "--count", "5", "--min-px", "16", "--json", str(out))
    assert json.loads(out.read_text(encoding="utf-8"))["mean grey"][2] == 0.5


@pytest.mark.parametrize("name", lookalike_video.PLACES)
def test_places_are_rendered_in_their_size(name: str, tmp_path: Path) -> None:
    out = tmp_path / "place.avi"
    run(lookalike_video.main, name, "--out", str(out), "--duration", "2", "--seed", "3")
    video = cv2.VideoCapture(str(out))
    ok, frame = video.read()
    assert ok
    assert frame.shape[1::-1] == lookalike_video.PLACES[name].size_wh
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 50


def test_an_unknown_place_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="city, motorway, freeway"):
        run(lookalike_video.main, "moon", "--out", str(tmp_path / "moon.avi"))


def test_the_benchmark_accounts_for_its_time(tmp_path: Path) -> None:
    found = benchmark_render.measure(2, (640, 360), 3, 0, tmp_path)
    assert found["frames"] == 3
    assert sum(found["stages_ms"].values()) == pytest.approx(found["ms_per_frame"], rel=0.1)


def test_the_benchmark_runs_with_a_faulty_camera(tmp_path: Path) -> None:
    assert benchmark_render.measure(2, (640, 360), 3, 0, tmp_path, faults=True)["frames"] == 3


def test_labels_of_boxes_are_exact_and_those_of_cars_are_not() -> None:
    scene = procedural_scene(np.random.default_rng([1, 41]), (1920, 1080))
    cases = label_truth.measure_scene(scene, 1, 12, 7, ["box", "saloon"])
    errors = {
        kind: [abs(c.cc[Rule.CONDITIONED] - c.exact_cc) for c in cases if c.kind == kind] for kind in ("box", "saloon")
    }
    assert len(errors["box"]) > 5
    assert np.median(errors["box"]) < 0.004 < np.median(errors["saloon"]) < 0.25
    assert "| saloon |" not in label_truth.page(cases[:5], 1, 0)
    assert "VP2-VP3" in label_truth.page(cases, 1, 0)
