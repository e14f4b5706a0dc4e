"""Anchor sizes and ratios fitted to the labels of a data set."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["fit_anchors"]


def fit_anchors(
    boxes_xyxy: ArrayLike,
    levels: int,
    per_level: int = 2,
    ratios: int = 3,
    tail: float = 0.02,
) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Fit anchors to boxes: sizes evenly spaced in the logarithm over the boxes' range, ratios at their quantiles.

    Args:
        boxes_xyxy: (N, 4) px, N at least 1.
        levels: number of pyramid levels.
        per_level: number of sizes on each level.
        ratios: number of ratios, the same on each level.
        tail: share of the boxes at either end of the range that is not covered; more gives finer steps for the rest.

    Returns:
        sizes per level, finest first (sides of square anchors, px), and ratios (height over width).
    """
    boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    low, high = np.quantile(np.log(sides).mean(axis=1), [tail, 1 - tail])
    # The outermost sizes are half a step inside the range: an anchor covers sizes around its own.
    count = levels * per_level
    step = (high - low) / count
    sizes = np.exp(low + step * (np.arange(count) + 0.5)).reshape(levels, per_level)
    quantiles = (np.arange(ratios) + 0.5) / ratios
    shapes = np.exp(np.quantile(np.log(sides[:, 1] / sides[:, 0]), quantiles))
    return tuple(tuple(float(v) for v in np.round(row, 1)) for row in sizes), tuple(
        float(v) for v in np.round(shapes, 3)
    )
