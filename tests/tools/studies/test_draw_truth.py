"""Drawing the exact truth into a frame."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
import typer
from typer.testing import CliRunner

from labelgen.errors import DataError
from labelgen.synth.truth.session import write_session
from tools.studies import draw_truth

pytestmark = pytest.mark.slow

NAME = "session0_center"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tools")
    write_session(out, duration_s=2, fps=5, size_wh=(480, 270), seed=4, per_minute=40)
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
