"""Values per track: medians, nearest points, and speeds over gaps of five points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.tracking.per_track import gap_speeds_kmh, median_per_track, nearest_rows

LENGTHS = st.lists(st.integers(0, 40), min_size=0, max_size=12)
VALUES = st.sampled_from([0.0, 1.0, 1.5, 2.0, 7.0, np.inf])


def offsets_of(lengths: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])


@settings(deadline=None, max_examples=60)
@given(LENGTHS, st.data())
def test_medians_are_numpys(lengths: list[int], data: st.DataObject) -> None:
    offsets = offsets_of(lengths)
    size = int(offsets[-1])
    values = np.array(data.draw(st.lists(VALUES, min_size=size, max_size=size)), dtype=np.float64)
    expected = [np.median(part) if len(part) else np.nan for part in np.split(values, offsets[1:-1])][: len(lengths)]
    np.testing.assert_array_equal(median_per_track(values, offsets), expected)


def test_one_nan_makes_its_tracks_median_unknown() -> None:
    values = np.array([1.0, np.nan, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(median_per_track(values, np.array([0, 3, 5])), [np.nan, 4.5])


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(3, 70), min_size=0, max_size=10), st.data())
def test_nearest_rows_are_those_of_a_stable_sort(lengths: list[int], data: st.DataObject) -> None:
    offsets = offsets_of(lengths)
    size = int(offsets[-1])
    distances = np.array(data.draw(st.lists(st.integers(0, 5), min_size=size, max_size=size)), dtype=np.float64)
    got = nearest_rows(distances, offsets, 3)
    assert got.shape == (len(lengths), 3)
    for number, rows in enumerate(got):
        part = distances[offsets[number] : offsets[number + 1]]
        np.testing.assert_array_equal(rows - offsets[number], np.argsort(part, kind="stable")[:3])


def test_speed_is_the_median_over_gaps_of_five_points() -> None:
    # 1 m per 0.1 s is 36 km/h; one point is 10 m astray, which touches two of the seven gaps.
    points = np.stack([np.arange(12.0), np.zeros(12)], axis=1)
    points[3, 1] = 10.0
    # The second track has five points and so no gap; the third one moves at twice the speed.
    points = np.concatenate([points, np.zeros((5, 2)), 2 * np.stack([np.arange(6.0), np.zeros(6)], axis=1)])
    times = np.concatenate([np.arange(12), np.arange(5), np.arange(6)]) / 10
    got = gap_speeds_kmh(points, times, np.array([0, 12, 17, 23]))
    np.testing.assert_allclose(got, [36.0, np.nan, 72.0])


@pytest.mark.parametrize(("step_m", "expected"), [(0.0, np.nan), (1.0, np.inf)])
def test_no_time_between_points(step_m: float, expected: float) -> None:
    points = np.stack([np.arange(8.0) * step_m, np.zeros(8)], axis=1)
    np.testing.assert_array_equal(gap_speeds_kmh(points, np.zeros(8), np.array([0, 8])), [expected])


def test_time_running_backwards_counts_unsigned() -> None:
    points = np.stack([np.arange(8.0), np.zeros(8)], axis=1)
    times = -np.arange(8) / 10
    np.testing.assert_allclose(gap_speeds_kmh(points, times, np.array([0, 8])), [36.0])
