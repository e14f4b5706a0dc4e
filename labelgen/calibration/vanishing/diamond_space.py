"""Diamond space: an accumulator for vanishing points that holds the whole projective plane, infinity included.

A line with all its points is mapped by two parallel-coordinate transforms in cascade. Worked out, the result is the
octahedron |X| + |Y| + |W| = 1 seen along Y: the homogeneous point (X, Y, W), signed so that Y <= 0, has the diamond
coordinates (u, v) = (W, X) / (|X| + |Y| + |W|). A line of the plane crosses each of the diamond's four triangles in one
straight piece, so voting is drawing pieces of straight lines.

Convention: points and lines are homogeneous (N, 3) in normalised coordinates, where the image is about [-1, 1] wide. A
line l holds the points p with l . p = 0. Accumulators are indexed [v, u].

Source: Dubska & Herout, "Real Projective Plane Mapping for Detection of Orthogonal Vanishing Points", BMVC 2013.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.geometry.homography import Array

__all__ = ["accumulate", "peak"]

RESOLUTION = 160
"""Cells from the middle of the diamond to its corner; more part lines that meet, fewer merge points."""


def accumulate(lines: ArrayLike, weights: ArrayLike | None = None, resolution: int = RESOLUTION) -> NDArray[np.float64]:
    """Return the votes of lines, each drawn once into every cell it passes.

    Args:
        lines: (N, 3) homogeneous.
        weights: (N,) of the votes; 1 without it.
        resolution: cells from the middle of the diamond to its corner.

    Returns:
        (2 resolution + 1, 2 resolution + 1), indexed [v, u]; zero outside the diamond.
    """
    a, b, c = np.asarray(lines, dtype=np.float64).reshape(-1, 3).T[:, :, None]
    votes = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    side = 2 * resolution + 1
    total = np.zeros(side * side)
    steps = np.arange(resolution + 1) / resolution
    for sign_u in (-1.0, 1.0):
        for sign_v in (-1.0, 1.0):
            # In a triangle of fixed signs Y = |u| + |v| - 1 is linear in u and v: p u + q v = b.
            p, q = b * sign_u + c, a + b * sign_v
            flat = np.abs(p) <= np.abs(q)
            with np.errstate(divide="ignore", invalid="ignore"):
                u = np.where(flat, sign_u * steps, (b - q * sign_v * steps) / p)
                v = np.where(flat, (b - p * sign_u * steps) / q, sign_v * steps)
                inside = (u * sign_u >= 0) & (v * sign_v >= 0) & (np.abs(u) + np.abs(v) <= 1)
            # The axes belong to two triangles and must not be voted for twice.
            inside &= ((sign_u > 0) | (u != 0)) & ((sign_v > 0) | (v != 0))
            column = np.rint(np.where(inside, u, 0) * resolution).astype(np.int64) + resolution
            row = np.rint(np.where(inside, v, 0) * resolution).astype(np.int64) + resolution
            cell = row * side + column
            total += np.bincount(cell[inside], np.broadcast_to(votes[:, None], cell.shape)[inside], side * side)
    return total.reshape(side, side)


def peak(votes: NDArray[np.float64], smoothing_cells: float = 1.0) -> tuple[Array, float]:
    """Return the point that most lines pass, and its votes.

    Args:
        votes: from `accumulate`.
        smoothing_cells: standard deviation of the Gaussian that smooths the votes, so that lines need not meet in one
            cell.

    Returns:
        (3,) homogeneous point of unit length, and the smoothed votes there.
    """
    smooth = cv2.GaussianBlur(votes, (0, 0), smoothing_cells)
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    resolution = votes.shape[0] // 2
    u, v = (np.array([column, row], dtype=np.float64) - resolution) / resolution
    point = np.array([v, abs(u) + abs(v) - 1, u])
    return point / np.linalg.norm(point), float(smooth[row, column])
