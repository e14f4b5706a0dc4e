"""The detector's benchmarks run and report; their figures are for quiet machines."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from detector_shards import write_painted_shards

from detector.checkpoint import METADATA_KEY, ModelMetadata
from detector.model.retinanet import ModelConfig, build_model
from labelgen.geometry import Pair
from labelgen.synth.truth.session import write_session
from tools.benchmarks import detector as benchmark_detector
from tools.benchmarks import loader as benchmark_loader
from tools.benchmarks import sizes as benchmark_sizes

pytestmark = pytest.mark.slow


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
    assert set(report["shards_over"]) == {"webdataset", "plain files"}


def test_plain_retinanet_finds_the_same_boxes() -> None:
    torch.manual_seed(0)
    ours = build_model(ModelConfig(backbone="mobilenet_v3_small", channels=32), score_thresh=0.005).eval()
    image = [torch.rand(3, 64, 96)]
    with torch.no_grad():
        a, b = ours(image)[0], benchmark_detector.plain_retinanet(ours)(image)[0]
    assert len(a["boxes"]) > 0
    assert torch.equal(a["boxes"], b["boxes"])
    assert torch.equal(a["scores"], b["scores"])


def test_sizes_benchmark(tmp_path: Path) -> None:
    session = write_session(tmp_path / "data", duration_s=0.6, fps=10, size_wh=(320, 180), seed=4, per_minute=40)
    config = ModelConfig(
        backbone="mobilenet_v3_small", channels=16, head_convs=1, levels=(3, 4), anchor_sizes=((32.0,), (64.0,))
    )
    model = build_model(config)
    metadata = ModelMetadata("paper-640x360", Pair.VP2_VP3, (640, 360), config, 10.0, [], {})
    checkpoint, out = tmp_path / "model.ckpt", tmp_path / "out.json"
    torch.save({"state_dict": model.state_dict(), METADATA_KEY: metadata.to_dict()}, checkpoint)
    benchmark_sizes.main(
        [str(checkpoint), str(Path(session.files["video"]).parent), "--sizes", "480x270", "270x480", "--frames", "4",
         "--rounds", "1", "--device", "cpu", "--no-compile", "--json", str(out)]
    )  # fmt: skip
    report = json.loads(out.read_text())
    assert report["frames"] == 4
    assert set(report["sizes"]) == {"480x270", "270x480"}
    for rows in report["sizes"].values():
        assert set(rows) == {"torchvision", "torchvision half", "float32", "half"}
        assert min(row["fps"] for row in rows.values()) > 0
