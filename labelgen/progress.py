"""Progress bars: with rate and time left on a terminal, a line now and then in a log, gone when something fails."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator

from tqdm import tqdm

__all__ = ["asked_to_stop", "progress_bar"]

_LOG_INTERVAL_S = 10.0


@contextlib.contextmanager
def progress_bar(total: int | None, unit: str, title: str = "") -> Iterator[Callable[[int], object]]:
    """Show progress on standard error; yields a function that takes the number of units done since its last call.

    Nothing is shown where the logger `labelgen` is set to say no more than warnings.

    Args:
        total: units to do; None where that is not known.
        unit: what is counted.
        title: what is being done.
    """
    terminal = sys.stderr.isatty()
    bar = tqdm(
        total=total,
        unit=unit,
        desc=title or None,
        dynamic_ncols=True,
        smoothing=0.1,
        disable=logging.getLogger("labelgen").level > logging.INFO,
        delay=0.0 if terminal else _LOG_INTERVAL_S,
        mininterval=0.1 if terminal else _LOG_INTERVAL_S,
    )
    try:
        yield bar.update
    except BaseException:
        bar.leave = False
        raise
    finally:
        bar.close()


@contextlib.contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a question to be asked between two items, so that none is left half done.

    Yields a function that says whether somebody asked; a second Ctrl-C interrupts at once.
    """
    asked = False

    def note(number: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    if threading.current_thread() is not threading.main_thread():
        yield lambda: asked
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)
