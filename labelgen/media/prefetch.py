"""Overlap the stages of a pipeline: run an iterator ahead in a thread, by a bounded number of items."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

__all__ = ["prefetch"]

_Item = TypeVar("_Item")
# How often a full queue checks whether the consumer has left, and how long the consumer waits for the thread to end.
_POLL_S, _JOIN_S = 0.05, 5.0


def prefetch(items: Iterable[_Item], depth: int) -> Iterator[_Item]:
    """Yield the same items in the same order, computed ahead of their use in a thread.

    An exception of the iterable is raised here, after the items before it. When this iterator is closed or abandoned,
    the thread stops at its next item.

    Args:
        items: iterated in the thread, and closed there if it has a `close` method.
        depth: greatest number of items that wait, at least 1.
    """
    waiting: queue.Queue[tuple[str, Any]] = queue.Queue(max(1, depth))
    stop = threading.Event()

    def put(kind: str, value: Any) -> None:
        while not stop.is_set():
            with contextlib.suppress(queue.Full):
                waiting.put((kind, value), timeout=_POLL_S)
                return

    def work() -> None:
        try:
            for item in items:
                put("item", item)
                if stop.is_set():
                    break
            put("end", None)
        # Every exception is passed on to the consumer.
        except BaseException as error:
            put("error", error)
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while True:
            kind, value = waiting.get()
            if kind == "error":
                raise value
            if kind == "end":
                return
            yield value
    finally:
        stop.set()
        thread.join(_JOIN_S)
