"""Robust statistics that the estimates share."""

from __future__ import annotations

import numpy as np

from labelgen.geometry.homography import Array

__all__ = ["robust_sd", "tukey_weights", "weighted_quantile"]

_MAD_TO_SD = 1.48
"""Standard deviation of a normal distribution over its median absolute deviation."""


def weighted_quantile(values: Array, weights: Array, share: float) -> float:
    """Return the value (of N) below which a share of the weight (N,) lies."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(total, share * total[-1])), len(values) - 1)]])


def robust_sd(z: Array, weights: Array) -> float:
    """Return the weighted median of |z| (N,) as a standard deviation, at least 0.05."""
    return max(_MAD_TO_SD * weighted_quantile(np.abs(z), weights, 0.5), 0.05)


def tukey_weights(residuals: Array, limit: Array | float) -> Array:
    """Return Tukey's biweight of residuals: 1 at 0, 0 from the limit on."""
    return np.asarray(np.maximum(1 - (residuals / limit) ** 2, 0) ** 2)
