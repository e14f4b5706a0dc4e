"""Anchors sized to the data."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["fit_anchors"]

_TAIL = 0.02


def fit_anchors(
    boxes_xyxy: ArrayLike,
    levels: int,
    per_level: int = 2,
    ratios: int = 3,
    scale_range: tuple[float, float] = (1.0, 1.0),
) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Sizes and shapes of anchors that cover the labels: evenly spread in the logarithm, without the outer 2 %.

    Args:
        boxes_xyxy: (N, 4) px, at least one.
        levels: number of pyramid levels.
        per_level: sizes on each.
        ratios: shapes, the same on each.
        scale_range: by which factors augmentation shrinks and grows the boxes.

    Returns:
        sizes per level, finest first (sides of square anchors, px), and ratios (height over width).
    """
    boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    low, high = np.quantile(np.log(sides).mean(axis=1), [_TAIL, 1 - _TAIL]) + np.log(scale_range)
    # The two outermost sizes stand half a step inside: an anchor covers a range around its own size.
    count = levels * per_level
    step = (high - low) / count
    sizes = np.exp(low + step * (np.arange(count) + 0.5)).reshape(levels, per_level)
    shares = (np.arange(ratios) + 0.5) / ratios
    shapes = np.exp(np.quantile(np.log(sides[:, 1] / sides[:, 0]), shares))
    return tuple(tuple(float(v) for v in np.round(row, 1)) for row in sizes), tuple(
        float(v) for v in np.round(shapes, 3)
    )
