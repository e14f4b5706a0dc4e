"""Ctrl-C and SIGTERM: between two items, never while results are moved up, and both in the same way."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

__all__ = ["Terminated", "defer_interrupt", "signal_of", "terminate_as_interrupt", "uninterrupted"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Terminated(KeyboardInterrupt):
    """SIGTERM came; whatever ends cleanly on Ctrl-C ends cleanly on it, too."""


def signal_of(err: BaseException | None) -> int:
    """Return the number of the signal that an exception stands for: SIGTERM for `Terminated`, else SIGINT."""
    return int(signal.SIGTERM if isinstance(err, Terminated) else signal.SIGINT)


@contextlib.contextmanager
def terminate_as_interrupt() -> Iterator[Callable[[], bool]]:
    """Raise `Terminated` in the main thread when SIGTERM comes, where nobody else handles it.

    Yields:
        A function that returns whether it came: others may make something else of the exception.
    """
    came = False

    def raise_terminated(number: int, frame: object) -> None:
        nonlocal came
        came = True
        raise Terminated

    if not _is_main_thread() or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield lambda: False
        return
    signal.signal(signal.SIGTERM, raise_terminated)
    try:
        yield lambda: came
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def defer_interrupt() -> Iterator[Callable[[], int]]:
    """Defer the first Ctrl-C or SIGTERM, so that the item in work is finished; a second one acts at once.

    Yields:
        A function that returns the number of the signal that came; 0 where none did.
    """
    came = 0

    def remember(number: int, frame: object) -> None:
        nonlocal came
        if came:
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt
        came = number

    with _handled_by(remember):
        yield lambda: came


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Finish the block whatever Ctrl-C or SIGTERM comes; the signal acts after it.

    In another thread than the main one nothing is deferred: signals do not reach it.
    """
    came: list[int] = []
    with _handled_by(lambda number, frame: came.append(number)):
        yield
    if came:
        signal.raise_signal(signal.Signals(came[0]))


@contextlib.contextmanager
def _handled_by(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Give both signals another handler for the time of the block."""
    if not _is_main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number in _SIGNALS:
        if before[number] not in (None, signal.SIG_IGN):
            signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            if old not in (None, signal.SIG_IGN):
                signal.signal(number, old)


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
