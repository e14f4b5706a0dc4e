"""The table of variants, on a small made-up session in place of a real one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from labelgen.synth.truth.session import write_session
from tools.studies.speed_variants import app, format_tables

pytestmark = pytest.mark.slow


@pytest.mark.slow
def test_measure_and_write(tmp_path: Path) -> None:
    write_session(
        tmp_path / "s", duration_s=8.0, fps=15.0, size_wh=(960, 540), seed=5, video=False, per_minute=30.0, heading=1
    )
    session = tmp_path / "s" / "dataset" / "session0_center"
    runner = CliRunner()
    done = runner.invoke(
        app, ["measure", str(session), "--out", str(tmp_path / "figures"), "--duration", "8", "--fps", "15"]
    )
    assert done.exit_code == 0, done.output
    part = json.loads((tmp_path / "figures" / "session0_center.json").read_text())
    rows = part["rows"]
    assert max(abs(error) for error in rows["true points"]["errors"] if error is not None) < 1e-3
    found = {name: [error for error in row["errors"] if error is not None] for name, row in rows.items()}
    assert len(found["transform3d VP2-VP3"]) >= 3
    assert sum(map(abs, found["transform3d VP2-VP3"])) < sum(map(abs, found["orig2d"]))

    page = tmp_path / "page.md"
    page.write_text("# Speeds\n\nWhat this is.\n\n## Result\n\nold figures\n")
    for _ in range(2):  # writing again changes nothing
        assert runner.invoke(app, ["write", str(tmp_path / "figures"), str(page)]).exit_code == 0
        text = page.read_text()
        assert text == f"# Speeds\n\nWhat this is.\n\n## Result\n\n{format_tables([part])}"


def test_nothing_measured(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["write", str(tmp_path), str(tmp_path / "page.md")])
    assert done.exit_code != 0
    assert "no figures there" in str(done.exception)
