"""Values per track, of tracks of different lengths, without a loop over the tracks.

Convention: the P points of N tracks stand one track after the other in one array. Track i has the rows
offsets[i]:offsets[i + 1] of it; offsets (N + 1,) int64.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array, IntArray

__all__ = ["gap_speeds_kmh", "median_per_track", "nearest_rows", "track_numbers"]

_MPS_TO_KMH = 3.6


def track_numbers(offsets: IntArray) -> IntArray:
    """Return (P,) the number of the track that each row belongs to."""
    return np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))


def _blocks(offsets: IntArray) -> Iterator[tuple[IntArray, IntArray, NDArray[np.bool_]]]:
    """Yield tracks of similar length as dense blocks.

    The lengths in a block differ by a factor of two at most, so that at most half of a block is padding.

    Yields:
        numbers (n,) of the tracks; their rows (n, w); (n, w) False for padding.
    """
    counts = np.diff(offsets)
    sizes = np.ceil(np.log2(np.maximum(counts, 1))).astype(np.int64)
    for size in np.unique(sizes[counts > 0]):
        tracks = np.flatnonzero((sizes == size) & (counts > 0))
        steps = np.arange(counts[tracks].max())
        inside = steps < counts[tracks, None]
        yield tracks, np.where(inside, offsets[tracks, None] + steps, 0), inside


def median_per_track(values: Array, offsets: IntArray) -> Array:
    """Return (N,) the median of the values (P,) of each track; NaN where one of them is NaN or a track has none."""
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
    """Return the rows of the nearest points of each track.

    Args:
        distances: (P,) finite.
        offsets: (N + 1,); every track has at least `count` points.
        count: number of rows per track.

    Returns:
        (N, count) rows, nearest first; points of equal distance in the order of the track.
    """
    out = np.empty((len(offsets) - 1, count), dtype=np.int64)
    for tracks, rows, inside in _blocks(offsets):
        block, each = np.where(inside, distances[rows], np.inf), np.arange(len(tracks))
        for rank in range(count):
            # argmin returns the first of equal values, as a stable sort does.
            nearest = block.argmin(axis=1)
            out[tracks, rank] = rows[each, nearest]
            block[each, nearest] = np.inf
    return out


def gap_speeds_kmh(points_m: Array, times_s: Array, offsets: IntArray, gap: int = 5) -> Array:
    """Return the speed of each track: the median over i of the speed between its points i and i + gap.

    Source: Sochor et al., IEEE T-ITS 2018, public evaluation script, median mode.

    Args:
        points_m: (P, 2) metres on the road.
        times_s: (P,) seconds.
        offsets: (N + 1,) first row of each track, and P.
        gap: points from one end of a measurement to the other.

    Returns:
        (N,) km/h; NaN for tracks of `gap` points or fewer, and where a gap has neither length nor duration.
    """
    rows = np.arange(len(times_s) - gap)
    track = track_numbers(offsets)
    rows = rows[track[rows] == track[rows + gap]] if len(rows) else rows
    metres = np.linalg.norm(points_m[rows + gap] - points_m[rows], axis=1)
    seconds = np.abs(times_s[rows + gap] - times_s[rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        speeds = metres / seconds * _MPS_TO_KMH
    gaps = np.maximum(np.diff(offsets) - gap, 0)
    return median_per_track(speeds, np.concatenate([[0], np.cumsum(gaps)]))
