"""The detector's benchmarks run and report; their figures are for quiet machines."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from detector_shards import write_painted_shards

from tools import benchmark_detector, benchmark_loader


def test_branch_benchmark(tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    benchmark_detector.main(
        ["--json", str(out), "branch", "--preset", "small", "--backbone", "mobilenet_v3_small", "--size", "96x64",
         "--pairs", "3"]
    )  # fmt: skip
    report = json.loads(out.read_text())
    assert report["pairs"] == 3
    assert 0.3 < report["median_ratio"] < 3


def test_loader_benchmark(tmp_path: Path) -> None:
    pytest.importorskip("webdataset")
    shards = write_painted_shards(tmp_path / "shards", 6)
    out = tmp_path / "out.json"
    benchmark_loader.main([str(shards), "--samples", "24", "--rounds", "2", "--json", str(out)])
    report = json.loads(out.read_text())
    assert set(report["median"]) == {"shards", "webdataset", "plain files"}
    assert min(report["median"].values()) > 0
