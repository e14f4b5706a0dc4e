"""The renderer's benchmark."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.benchmarks import render as benchmark_render

pytestmark = pytest.mark.slow


def test_the_benchmark_accounts_for_its_time(tmp_path: Path) -> None:
    report = benchmark_render.measure(2, (640, 360), 3, 0, tmp_path)
    assert report["frames"] == 3
    assert sum(report["stages_ms"].values()) == pytest.approx(report["ms_per_frame"], rel=0.1)


def test_the_benchmark_runs_with_a_faulty_camera(tmp_path: Path) -> None:
    assert benchmark_render.measure(2, (640, 360), 3, 0, tmp_path, faults=True)["frames"] == 3
