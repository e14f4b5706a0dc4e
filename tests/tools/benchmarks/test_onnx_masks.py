"""The benchmark of ONNX masks runs and reports; its figures are for quiet machines."""

from __future__ import annotations

import json
from pathlib import Path

from clips import write_clip
from onnx_graphs import COCO_NAMES, Found, write_network, yolo_raw

from tools.benchmarks import onnx_masks


def test_onnx_benchmark(tmp_path: Path) -> None:
    clip = write_clip(tmp_path, 12, coco=False)
    outputs = yolo_raw([Found((40, 60, 90, 90), 2, 0.9)], (128, 128))
    metadata = {"names": {**{i: f"thing {i}" for i in range(80)}, **COCO_NAMES}}
    network = write_network(tmp_path / "net.onnx", outputs, [1, 3, 128, 128], metadata=metadata)
    report = tmp_path / "report.json"
    onnx_masks.main([str(network), str(clip), "--frames", "4", "--every", "2", "--json", str(report)])
    measured = json.loads(report.read_text())
    assert measured["frames"] == 4
    assert measured["ratio"] == measured["bare_s"] / measured["labels_s"]
    assert min(measured["bare_s"], measured["labels_s"]) > 0
