"""Running ahead in a thread: the same items, the same errors, and an end to it."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator

import pytest

from labelgen.media.prefetch import prefetch


@pytest.mark.parametrize("depth", [1, 3, 100])
@pytest.mark.parametrize("count", [0, 1, 50])
def test_the_same_items(depth: int, count: int) -> None:
    assert list(prefetch(range(count), depth)) == list(range(count))


def test_errors_come_after_the_items_before_them() -> None:
    def broken() -> Iterator[int]:
        yield from range(3)
        raise ValueError("no more")

    items = prefetch(broken(), 2)
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="no more"):
        next(items)


def test_it_runs_ahead_but_no_farther_than_asked() -> None:
    made = []
    enough = threading.Event()

    def counted() -> Iterator[int]:
        for number in itertools.count():
            made.append(number)
            if number >= 5:
                enough.set()
            yield number

    items = prefetch(counted(), 4)
    assert next(items) == 0
    assert enough.wait(10)  # it went on without being asked
    assert next(items) == 1
    assert max(made) <= 2 + 4 + 1
    items.close()  # type: ignore[attr-defined]


def test_closing_stops_the_thread_and_closes_what_it_reads() -> None:
    closed = threading.Event()

    def endless() -> Iterator[int]:
        try:
            yield from itertools.count()
        finally:
            closed.set()

    items = prefetch(prefetch(endless(), 2), 2)
    assert next(items) == 0
    items.close()  # type: ignore[attr-defined]
    assert closed.wait(10)
