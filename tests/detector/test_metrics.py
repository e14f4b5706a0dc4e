"""Evaluation of detections, on cases with known results."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from detector_shards import painted_sample

from detector.metrics import average_precision, evaluate_detections, match_boxes
from labelgen.errors import LabelgenError
from labelgen.geometry import decode_boxes, front_bottom_midpoints
from labelgen.labels import IgnoredBoxes, Labels, Sample

SAMPLES = [s for s in (painted_sample(seed) for seed in range(12)) if len(s.labels)]


def perfect(sample: Sample) -> Labels:
    return scored(sample.labels.boxes_xyxy, sample.labels.cc, np.linspace(0.9, 0.8, len(sample.labels)))


def scored(boxes_xyxy: Any, cc: Any, scores: Any) -> Labels:
    return Labels(np.asarray(boxes_xyxy), np.asarray(cc), scores=np.asarray(scores))


def test_perfect_detections() -> None:
    result = evaluate_detections((sample, perfect(sample)) for sample in SAMPLES)
    assert [result[key] for key in ("ap", "ap50", "ap75", "ap50_whole")] == pytest.approx([1, 1, 1, 1])
    assert result["recall"] == result["precision"] == 1
    assert result["invalid_share"] == 0
    assert result["cc_error"]["median"] == 0
    assert result["ground_m"]["p95"] == pytest.approx(0, abs=1e-9)


def test_no_detections() -> None:
    empty = Labels.empty()
    result = evaluate_detections((sample, empty) for sample in SAMPLES)
    assert result["ap"] == result["recall"] == 0
    assert result["precision"] is None
    assert result["cc_error"] == {"n": 0, "median": None, "mean": None, "p95": None}


def test_ap_of_a_hand_computed_case() -> None:
    """Two labels; detections right, wrong, right: precision 1 up to recall 1/2, then 2/3 (COCO samples 101 recalls)."""
    truth = np.array([[0.0, 0, 10, 10], [50, 0, 60, 10]])
    detections = scored(
        np.array([[0.0, 0, 10, 10], [200, 0, 210, 10], [50, 0, 60, 10]]), np.zeros(3), np.array([0.9, 0.8, 0.7])
    )
    result = average_precision([truth], [np.zeros(2, dtype=np.bool_)], [detections])
    assert result["ap50"] == pytest.approx((51 * 1 + 50 * 2 / 3) / 101)


def test_iou_thresholds_of_ap() -> None:
    truth = np.array([[0.0, 0, 100, 10]])
    # IoU 0.7: right for 0.5 to 0.7, five of the ten thresholds.
    detections = scored(np.array([[0.0, 0, 70.1, 10]]), np.zeros(1), np.ones(1))
    result = average_precision([truth], [np.zeros(1, dtype=np.bool_)], [detections])
    assert (result["ap50"], result["ap75"], result["ap"]) == pytest.approx((1.0, 0.0, 0.5))


def test_ignored_labels_cost_nothing_either_way() -> None:
    truth = np.array([[0.0, 0, 10, 10], [50, 0, 60, 10]])
    ignored = np.array([False, True])
    one = scored(truth[:1], np.zeros(1), np.array([0.5]))
    both = scored(truth[::-1], np.zeros(2), np.array([0.9, 0.5]))
    for detections in (one, both):
        assert average_precision([truth], [ignored], [detections])["ap50"] == pytest.approx(1)


# Boxes of one detection beside that of the label; share of it in the ignored box; whether it costs precision.
@pytest.mark.parametrize(
    ("box", "costs"),
    [
        ([100, 0, 110, 10], False),
        ([105, 0, 115, 10], False),  # half of it: enough at every threshold of IoU
        ([106, 0, 116, 10], True),
        ([100, 0, 140, 40], True),
    ],
)
def test_detections_in_ignored_boxes_count_neither_way(box: list[float], costs: bool) -> None:
    truth, around = np.array([[0.0, 0, 10, 10]]), np.array([[98.0, 0, 110, 10]])
    detections = scored([[float(v) for v in box], *truth.tolist()], np.zeros(2), [0.9, 0.5])
    nothing = [np.zeros(1, dtype=np.bool_)]
    result = average_precision([truth], nothing, [detections], [around])
    assert list(result.values()) == pytest.approx([0.5 if costs else 1.0] * 3)
    assert average_precision([truth], nothing, [detections])["ap50"] == pytest.approx(0.5)
    # A detection that matches a label is right, also inside an ignored box.
    inside = average_precision([truth], nothing, [scored(truth, np.zeros(1), [0.5])], [np.array([[-5.0, -5, 30, 30]])])
    assert inside["ap"] == pytest.approx(1)
    # Ignored boxes are no labels that could be missed.
    nobody = average_precision([truth], nothing, [scored(truth, np.zeros(1), [0.5])], [around])
    assert nobody["ap"] == pytest.approx(1)


def test_ignored_boxes_leave_detections_out_of_all_figures() -> None:
    sample = SAMPLES[0]
    extra = np.array([[2.0, 2, 12, 12]])
    detections = scored(
        np.concatenate([extra, sample.labels.boxes_xyxy]),
        np.concatenate([[0.5], sample.labels.cc]),
        np.ones(len(sample.labels) + 1),
    )
    plain = evaluate_detections([(sample, detections)])
    result = evaluate_detections([(replace(sample, ignored=IgnoredBoxes(extra)), detections)])
    assert plain["precision"] < 1
    assert plain["detections_ignored"] == plain["ignored_boxes"] == 0
    assert (result["precision"], result["recall"], result["ap"]) == (1, 1, pytest.approx(1))
    assert (result["ignored_boxes"], result["detections_ignored"]) == (1, 1)
    assert result["detections"] == plain["detections"] - 1


def test_errors_of_cc_and_ground_point() -> None:
    sample = SAMPLES[0]
    shifted = scored(sample.labels.boxes_xyxy, sample.labels.cc + 0.05, np.ones(len(sample.labels)))
    result = evaluate_detections([(sample, shifted)])
    assert result["cc_error"]["median"] == pytest.approx(0.05)
    vpu = sample.rectification.vpu
    feet = [
        sample.rectification.points_back(front_bottom_midpoints(decode_boxes(sample.labels.boxes_xyxy, cc, vpu)[0]))
        for cc in (sample.labels.cc, sample.labels.cc + 0.05)
    ]
    assert result["ground_px"]["median"] == pytest.approx(np.median(np.linalg.norm(feet[0] - feet[1], axis=1)))
    road = [sample.camera.road_points(points) for points in feet]
    assert result["ground_m"]["median"] == pytest.approx(np.median(np.linalg.norm(road[0] - road[1], axis=1)))


def test_low_detections_are_left_out_where_low_labels_were_never_made() -> None:
    sample = SAMPLES[0]
    labels = sample.labels
    low = np.array([[0.0, 0, 20, 8]])
    detections = scored(
        np.concatenate([low, labels.boxes_xyxy]), np.concatenate([[0.5], labels.cc]), np.ones(len(labels) + 1)
    )
    assert evaluate_detections([(sample, detections)])["precision"] < 1
    assert evaluate_detections([(sample, detections)], min_height_px=10)["precision"] == 1


def test_each_label_is_found_once_by_the_best_score() -> None:
    truth = np.array([[0.0, 0, 10, 10]])
    detections = np.array([[0.0, 0, 10, 9], [0.0, 0, 10, 10], [100.0, 0, 110, 10]])
    assert match_boxes(truth, detections, np.array([0.9, 0.8, 0.7])).tolist() == [0, -1, -1]
    assert match_boxes(np.empty((0, 4)), detections, np.ones(3)).tolist() == [-1, -1, -1]


def test_no_samples_is_an_error() -> None:
    with pytest.raises(LabelgenError, match="no samples"):
        evaluate_detections([])
