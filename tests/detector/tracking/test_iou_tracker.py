"""The tracker on small tables of boxes with known tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.tracking.iou_tracker import DUPLICATE, IouTracker, TrackRules
from labelgen.errors import DataError
from labelgen.geometry.boxes import iou_matrix

A, B = [0, 0, 10, 10], [100, 0, 110, 10]


def shifted(box: list[float], dx: float, dy: float = 0.0) -> list[float]:
    return [box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (A, A, 1.0),
        (A, shifted(A, 5), 50 / 150),
        (A, shifted(A, 10), 0.0),  # they touch
        (A, [2, 2, 4, 4], 4 / 100),
        (A, [5, 5, 5, 5], 0.0),  # no area
        (A, [8, 8, 2, 2], 0.0),  # inside out
    ],
)
def test_overlap_of_two_boxes(first: list[float], second: list[float], expected: float) -> None:
    assert iou_matrix([first], [second])[0, 0] == pytest.approx(expected)
    assert iou_matrix([second], [first])[0, 0] == pytest.approx(expected)


def test_overlap_of_nothing_has_a_shape() -> None:
    assert iou_matrix(np.empty((0, 4)), [A, B]).shape == (0, 2)
    assert iou_matrix([A], np.empty((0, 4))).shape == (1, 0)


# Each case: rules, frames as (number, boxes, scores or None), the tracks expected for each, the tracks ended before it.
CASES: dict[str, tuple[dict[str, Any], list[tuple[int, list[list[float]], list[float] | None]], list[list[int]]]] = {
    "two vehicles keep their numbers whatever the order of the boxes": (
        {}, [(0, [A, B], None), (1, [shifted(B, 1), shifted(A, 1)], None), (2, [shifted(A, 2), shifted(B, 2)], None)],
        [[1, 2], [2, 1], [1, 2]],
    ),
    "overlap of exactly the least is not enough": (
        {"min_iou": 1 / 3}, [(0, [A], None), (1, [shifted(A, 5)], None)], [[1], [2]],
    ),
    "frames without boxes are survived": (
        {}, [(0, [A], None), (1, [], None), (2, [], None), (3, [A], None)], [[1], [], [], [1]],
    ),
    "ten frames without a box are survived": ({}, [(0, [A], None), (11, [A], None)], [[1], [1]]),
    "eleven are not": ({}, [(0, [A], None), (12, [A], None)], [[1], [2]]),
    "no gap is survived where none is allowed": (
        {"max_missed": 0}, [(0, [A], None), (1, [A], None), (3, [A], None)], [[1], [1], [2]],
    ),
    "the greatest overlap wins, not the first box": (
        {}, [(0, [A], None), (1, [shifted(A, 4), shifted(A, 1)], None)], [[1], [2, 1]],
    ),
    "of equal overlaps the better score wins": (
        {}, [(0, [A], None), (1, [shifted(A, 3), shifted(A, -3)], [0.6, 0.9])], [[1], [2, 1]],
    ),
    "a track takes one box a frame": (
        {"duplicate_iou": 1.0}, [(0, [A], None), (1, [A, A], None), (2, [A, A], None)], [[1], [1, 2], [1, 2]],
    ),
    "a repeated box joins no track": (
        {}, [(0, [A, shifted(A, 0.5)], [0.7, 0.9]), (1, [A, A, A], [0.5, 0.9, 0.6])],
        [[DUPLICATE, 1], [DUPLICATE, 1, DUPLICATE]],
    ),
    "what repeats a repetition alone is kept": (
        {"duplicate_iou": 0.6}, [(0, [A, shifted(A, 2), shifted(A, 4)], [0.9, 0.8, 0.7])], [[1, DUPLICATE, 2]],
    ),
    "merged vehicles: the one that covers more goes on, the other waits and comes back": (
        {}, [
            (0, [[0, 0, 10, 20], [8, 0, 14, 10]], None),
            (1, [[0, 0, 14, 20]], None),
            (2, [[0, 0, 14, 20]], None),
            (3, [[8, 0, 14, 10], [0, 0, 10, 20]], None),
        ],
        [[1, 2], [1], [1], [2, 1]],
    ),
    "numbers are not used again": ({}, [(0, [A], None), (20, [A], None), (40, [A], None)], [[1], [2], [3]]),
    "nothing at all": ({}, [(0, [], None), (5, [], None)], [[], []]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_tracks(name: str) -> None:
    rules, frames, expected = CASES[name]
    tracker = IouTracker(TrackRules(**rules))
    assert [tracker.update(number, boxes, scores)[0].tolist() for number, boxes, scores in frames] == expected


def test_tracks_end_when_their_time_is_over() -> None:
    tracker = IouTracker(TrackRules(max_missed=2))
    assert tracker.update(0, [A, B])[1] == []
    assert tracker.update(1, [A])[1] == []
    assert tracker.update(3, [A])[1] == []  # B was missed in frames 1, 2
    assert tracker.update(4, [A])[1] == [2]  # and 3
    assert tracker.finish() == [1]
    assert tracker.finish() == []


def test_frames_come_in_order() -> None:
    tracker = IouTracker()
    tracker.update(3, [A])
    with pytest.raises(DataError, match="frame 3 after frame 3"):
        tracker.update(3, [A])


@pytest.mark.parametrize("box", [[0, 0, np.nan, 1], [0, 0, np.inf, 1]])
def test_boxes_are_finite(box: list[float]) -> None:
    with pytest.raises(DataError, match="not finite"):
        IouTracker().update(0, [box])


@pytest.mark.parametrize("wrong", [{"min_iou": 1.5}, {"min_iou": -0.1}, {"duplicate_iou": 2}, {"max_missed": -1}])
def test_wrong_rules_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(DataError, match=next(iter(wrong))):
        TrackRules(**wrong)


BOXES = st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20), st.integers(1, 12), st.integers(1, 12)), max_size=5)


@settings(max_examples=40, deadline=None)
@given(st.lists(BOXES, min_size=1, max_size=8))
def test_any_boxes(frames: list[list[tuple[int, int, int, int]]]) -> None:
    """A track has one box a frame; every track ends once; each step's overlap is above the least."""
    tracker = IouTracker(TrackRules(max_missed=1))
    last: dict[int, list[float]] = {}
    ended: list[int] = []
    for number, frame in enumerate(frames):
        boxes = [[x, y, x + w, y + h] for x, y, w, h in frame]
        ids, over = tracker.update(number, boxes)
        ended += over
        joined = [i for i in ids.tolist() if i != DUPLICATE]
        assert len(joined) == len(set(joined))
        assert not set(joined) & set(ended)
        for box, track in zip(boxes, ids.tolist(), strict=True):
            if track in last:
                assert iou_matrix([box], [last[track]])[0, 0] > 0.1
            if track != DUPLICATE:
                last[track] = [float(v) for v in box]
    ended += tracker.finish()
    assert sorted(ended) == sorted(last)
