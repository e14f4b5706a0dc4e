"""Boxes around what is marked, and samples in order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from labelgen.masks.background.morphology import MARGIN_PX, disjoint_boxes
from labelgen.masks.background.sorting_network import sort_samples


@settings(deadline=None, max_examples=40)
@given(
    size=st.tuples(st.integers(1, 90), st.integers(1, 120)),
    places=st.lists(st.tuples(st.integers(0, 89), st.integers(0, 119), st.integers(0, 2)), max_size=12),
)
def test_boxes_hold_all_that_is_marked_with_a_margin(size: tuple[int, int], places: list[tuple[int, int, int]]) -> None:
    height, width = size
    marked = np.zeros((height, width, 3), dtype=np.uint8)
    inside = [(y % height, x % width, c) for y, x, c in places]
    for place in inside:
        marked[place] = 7
    boxes = disjoint_boxes(marked)
    covered = np.zeros(size, dtype=int)
    for box in boxes:
        covered[box] += 1
    assert covered.max(initial=0) <= 1
    assert bool(boxes) == bool(inside)
    for y, x, _ in inside:
        rows, columns = next((r, c) for r, c in boxes if r.start <= y < r.stop and c.start <= x < c.stop)
        for at, side, limit in ((y, rows, height), (x, columns, width)):
            assert side.start == 0 or at - side.start >= MARGIN_PX
            assert side.stop == limit or side.stop - 1 - at >= MARGIN_PX


def test_what_lies_far_apart_gets_boxes_of_its_own() -> None:
    marked = np.zeros((360, 640, 3), dtype=np.uint8)
    marked[40:60, 100:140] = marked[300:320, 500:540] = 1
    assert sum((r.stop - r.start) * (c.stop - c.start) for r, c in disjoint_boxes(marked)) < 0.03 * 360 * 640


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 15, 16, 40, 64, 127])
def test_samples_come_in_order(count: int) -> None:
    samples = np.random.default_rng(count).integers(0, 256, (count, 5, 30, 3), dtype=np.uint8)
    before = samples.copy()
    np.testing.assert_array_equal(sort_samples(samples), np.sort(samples, axis=0))
    np.testing.assert_array_equal(samples, before)
