"""Progress bars, and interruption between two items."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator

from tqdm import tqdm

from labelgen.printable import printable

__all__ = ["defer_interrupt", "progress_bar"]

_LOG_INTERVAL_S = 10.0


@contextlib.contextmanager
def progress_bar(total: int | None, unit: str, title: str = "") -> Iterator[Callable[[int], object]]:
    """Show a progress bar on standard error: live on a terminal, one line in ten seconds in a log.

    Nothing is shown where the level of the logger `labelgen` is above INFO.

    Args:
        total: number of units; None where unknown.
        unit: name of a unit.
        title: text before the bar.

    Yields:
        A function that takes the number of units done since its last call.
    """
    terminal = sys.stderr.isatty()
    bar = tqdm(
        total=total,
        unit=unit,
        desc=printable(title) or None,
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
def defer_interrupt() -> Iterator[Callable[[], bool]]:
    """Defer the first interruption (Ctrl-C), so that the item in work is finished; a second one acts at once.

    Yields:
        A function that returns whether an interruption came.
    """
    interrupted = False

    def remember(number: int, frame: object) -> None:
        nonlocal interrupted
        if interrupted:
            raise KeyboardInterrupt
        interrupted = True

    if threading.current_thread() is not threading.main_thread():
        yield lambda: interrupted
        return
    before = signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: interrupted
    finally:
        signal.signal(signal.SIGINT, before)
