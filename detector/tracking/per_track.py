"""Per-track values of tracks of different lengths, without a loop over the tracks.

Convention: the points of all tracks lie back to back in one array; track i owns the rows offsets[i]:offsets[i + 1].
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array, IntArray

__all__ = ["gap_speeds_kmh", "median_per_track", "nearest_rows", "owners"]


_MPS_TO_KMH = 3.6


def owners(offsets: IntArray) -> IntArray:
    """(P,) which track each row belongs to."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))


def _blocks(offsets: IntArray) -> Iterator[tuple[IntArray, IntArray, NDArray[np.bool_]]]:
    """Tracks of similar length as dense blocks: their numbers (n,), rows (n, w), and which of these are theirs.

    Rows of one length could be wide for one long track among many short ones; doubling lengths waste half at most.
    """
    counts = np.diff(offsets)
    sizes = np.ceil(np.log2(np.maximum(counts, 1))).astype(np.int64)
    for size in np.unique(sizes[counts > 0]):
        tracks = np.flatnonzero((sizes == size) & (counts > 0))
        steps = np.arange(counts[tracks].max())
        inside = steps < counts[tracks, None]
        yield tracks, np.where(inside, offsets[tracks, None] + steps, 0), inside


def median_per_track(values: Array, offsets: IntArray) -> Array:
    """(N,) median of each track's values; NaN where a value is NaN or a track has none."""
    out = np.full(len(offsets) - 1, np.nan)
    for tracks, rows, inside in _blocks(offsets):
        block = np.where(inside, values[rows], np.inf)
        unknown = np.isnan(block).any(axis=1)
        block.sort(axis=1)
        count, each = inside.sum(axis=1), np.arange(len(tracks))
        middle = (block[each, (count - 1) // 2] + block[each, count // 2]) / 2
        out[tracks] = np.where(unknown, np.nan, middle)
    return out


def nearest_rows(distances: Array, offsets: IntArray, count: int) -> IntArray:
    """(N, count) rows of each track's nearest points, nearest first, equal ones in track order.

    Args:
        distances: (P,), finite.
        offsets: (N + 1,); every track has at least `count` points.
        count: how many rows to take.
    """
    out = np.empty((len(offsets) - 1, count), dtype=np.int64)
    for tracks, rows, inside in _blocks(offsets):
        block, each = np.where(inside, distances[rows], np.inf), np.arange(len(tracks))
        for rank in range(count):
            # argmin gives the first of equal ones, which is what a stable sort would.
            nearest = block.argmin(axis=1)
            out[tracks, rank] = rows[each, nearest]
            block[each, nearest] = np.inf
    return out


def gap_speeds_kmh(points_m: Array, times_s: Array, offsets: IntArray, gap: int = 5) -> Array:
    """Speed of each track: the median over i of the speed between its points i and i + gap.

    Args:
        points_m: (P, 2) metres on the road.
        times_s: (P,) seconds.
        offsets: (N + 1,) where each track starts.
        gap: points between the two ends of a measurement.

    Returns:
        (N,) km/h; NaN for tracks of `gap` points or fewer, and where a gap has neither length nor duration.

    Source: Sochor et al., IEEE T-ITS 2018 (public evaluation script, median mode).
    """
    rows = np.arange(len(times_s) - gap)
    track = owners(offsets)
    rows = rows[track[rows] == track[rows + gap]] if len(rows) else rows
    metres = np.linalg.norm(points_m[rows + gap] - points_m[rows], axis=1)
    seconds = np.abs(times_s[rows + gap] - times_s[rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        speeds = metres / seconds * _MPS_TO_KMH
    gaps = np.maximum(np.diff(offsets) - gap, 0)
    return median_per_track(speeds, np.concatenate([[0], np.cumsum(gaps)]))
