"""Lanes between lines of the image.

Convention:
    Points are (P, 2) float64 px as x, y. Lines are (L, 3) float64 as a, b, c with a x + b y + c = 0; the signed value
    of a line at a point is a x + b y + c.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array, IntArray

__all__ = ["between_lines", "lanes_of", "line_values"]


def line_values(points_px: Array, lines: Array) -> Array:
    """Return the signed values (P, L) of lines (L, 3) at points (P, 2)."""
    return points_px[:, :1] * lines[:, 0] + points_px[:, 1:] * lines[:, 1] + lines[:, 2]


def between_lines(first: Array, second: Array, line_a: Array, line_b: Array) -> NDArray[np.bool_]:
    """Return which points lie between two lines, points on a line included.

    Args:
        first: (P,) signed values of the first line at the points.
        second: (P,) those of the second line.
        line_a: (3,) the first line.
        line_b: (3,) the second line.

    Returns:
        (P,) bool.
    """
    return np.asarray(first * second * (line_a[:2] @ line_b[:2]) <= 0)


def lanes_of(points_px: Array, lane_lines: Array) -> IntArray:
    """Return the number of the lane in which each point lies.

    Args:
        points_px: (P, 2) px.
        lane_lines: (L + 1, 3) lines, lane i lying between lines i and i + 1.

    Returns:
        (P,) int64; the first lane for points on a common border, -1 outside of all lanes and for NaN.
    """
    lane = np.full(len(points_px), -1)
    values = line_values(points_px, lane_lines)
    for number in reversed(range(len(lane_lines) - 1)):
        inside = between_lines(values[:, number], values[:, number + 1], lane_lines[number], lane_lines[number + 1])
        lane[inside] = number
    return lane
