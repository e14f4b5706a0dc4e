"""Lanes between lines of the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array, IntArray

__all__ = ["between_lines", "lanes_of", "line_values"]


def line_values(points_px: Array, lines: Array) -> Array:
    """Return the signed values (P, L) of homogeneous lines (L, 3) at points (P, 2)."""
    return points_px[:, :1] * lines[:, 0] + points_px[:, 1:] * lines[:, 1] + lines[:, 2]


def between_lines(first: Array, second: Array, line_a: Array, line_b: Array) -> NDArray[np.bool_]:
    """Whether points lie between two lines, from their signed values at the points; borders included."""
    return np.asarray(first * second * (line_a[:2] @ line_b[:2]) <= 0)


def lanes_of(points_px: Array, lane_lines: Array) -> IntArray:
    """(P,) number of the first lane each point lies in, its borders included; -1 for none (also for NaN)."""
    lane = np.full(len(points_px), -1)
    values = line_values(points_px, lane_lines)
    for number in reversed(range(len(lane_lines) - 1)):
        inside = between_lines(values[:, number], values[:, number + 1], lane_lines[number], lane_lines[number + 1])
        lane[inside] = number
    return lane
