"""The benchmark of scoring."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tools.benchmarks import score as benchmark_score


def test_benchmark_compares_equal_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmark_score", "--limit", "40", "--json", str(tmp_path / "out.json")])
    benchmark_score.main()
    data = json.loads((tmp_path / "out.json").read_text())
    assert [row["agree"] for row in data["rows"]] == [True]
    assert "40 vehicles" in capsys.readouterr().out
