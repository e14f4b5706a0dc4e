"""Anchors fitted to the boxes of a data set."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detector.model.anchor_fit import fit_anchors


def best_iou(boxes: np.ndarray, sizes: Sequence[Sequence[float]], ratios: Sequence[float]) -> np.ndarray:
    """(N,) IoU of each box with the best anchor of the same centre."""
    sides = (boxes[:, 2:] - boxes[:, :2])[:, None]
    anchors = np.array([[s / np.sqrt(r), s * np.sqrt(r)] for row in sizes for s in row for r in ratios])
    shared = np.minimum(sides, anchors).prod(axis=-1)
    return (shared / (sides.prod(axis=-1) + anchors.prod(axis=-1) - shared)).max(axis=1)


def test_anchors_cover_boxes_of_all_sizes() -> None:
    rng = np.random.default_rng(0)
    sides = np.exp(rng.uniform(np.log(12), np.log(200), (500, 1))) * np.exp(rng.normal(0, 0.2, (500, 2)))
    boxes = np.concatenate([np.zeros((500, 2)), sides], axis=1)
    sizes, ratios = fit_anchors(boxes, levels=3, per_level=2)
    assert [len(row) for row in sizes] == [2, 2, 2]
    assert sorted(v for row in sizes for v in row) == [v for row in sizes for v in row]
    assert len(ratios) == 3
    assert np.mean(best_iou(boxes, sizes, ratios) >= 0.5) > 0.97
