"""Stages of a pipeline that overlap: an iterator that runs ahead in a thread, by a bounded number of items."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

__all__ = ["prefetch"]

_Item = TypeVar("_Item")
_POLL_S = 0.05
_LEAVE_S = 5.0


def prefetch(items: Iterable[_Item], depth: int) -> Iterator[_Item]:
    """The same items, in the same order, made ahead of their use in a thread.

    What the iterable raises is raised here, after the items before it. When this iterator is closed or abandoned the
    thread stops at its next item.

    Args:
        items: run in the thread, and closed there if it can be.
        depth: how many items may wait, at least 1.
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
        # Whatever it is, it belongs to who iterates, not to this thread.
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
        thread.join(_LEAVE_S)
