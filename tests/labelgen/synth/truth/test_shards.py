"""Shards with exact truth say what the truth says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from clips import CAMERA, vehicle_boxes

from labelgen.geometry import Pair, Rectification
from labelgen.labels import Flag, IgnoreReason
from labelgen.shards import ShardDataset
from labelgen.synth.truth.session import write_session
from labelgen.synth.truth.shards import EXACT_LABEL_LIMITS, exact_labels, main


@pytest.mark.slow
def test_labels_decode_to_the_true_boxes(tmp_path: Path) -> None:
    write_session(tmp_path, duration_s=4, fps=1, size_wh=(640, 360), seed=4, name="made", per_minute=40)
    main([tmp_path / "dataset" / "made"], tmp_path / "shards", size="320x180")
    samples = ShardDataset([tmp_path / "shards"])
    assert len(samples)
    lines = [json.loads(line) for line in (tmp_path / "truth" / "made" / "boxes.jsonl").read_text().splitlines()]
    compared = 0
    for i in range(len(samples)):
        sample = samples[i]
        truth = np.array([vehicle["vertices_px"] for vehicle in lines[sample.frame]["vehicles"]])
        boxes = sample.labels.boxes_xyxy
        assert (boxes >= 0).all()
        assert (boxes <= [320, 180, 320, 180]).all()
        assert (boxes[:, 3] - boxes[:, 1] >= EXACT_LABEL_LIMITS.min_height_px - 1e-3).all()
        vertices, valid = sample.vertices_px()
        for corners in vertices[valid & ~sample.labels.has(Flag.TRUNCATED)]:
            # As sets of corners: the truth's front is the vehicle's own.
            gaps = np.linalg.norm(truth[:, :, None] - corners[None, None], axis=-1).min(axis=2).max(axis=1)
            assert gaps.min() < 0.05
            compared += 1
    assert compared >= 2


@pytest.mark.parametrize(
    ("shift_px", "visible", "scale", "labels", "reasons"),
    [
        (0, 1.0, 1.0, 1, []),
        (0, None, 1.0, 1, []),
        (0, 0.2, 1.0, 0, [IgnoreReason.OTHER]),
        (0, 0.0, 1.0, 0, []),  # nothing of it shows
        (0, 1.0, 0.1, 0, [IgnoreReason.TOO_SMALL]),
        (-220, 1.0, 1.0, 0, [IgnoreReason.CUT]),
        (-400, 1.0, 1.0, 0, []),  # outside
    ],
)
def test_vehicles_without_a_label_are_ignored_where_they_show(
    shift_px: float, visible: float | None, scale: float, labels: int, reasons: list[IgnoreReason]
) -> None:
    rectification = Rectification.from_window(CAMERA, [0, 0, *CAMERA.image_wh], Pair.VP2_VP3, (640, 360))
    corners = vehicle_boxes(20)[0]
    middle = corners.mean(axis=0)
    vehicle = {"vertices_px": (middle + scale * (corners - middle) + [shift_px, 0]).tolist(), "visible": visible}
    found, ignored = exact_labels([vehicle], rectification)
    assert len(found) == labels
    assert ignored.reasons.tolist() == reasons
