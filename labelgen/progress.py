"""Progress bars."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable, Iterator

from tqdm import tqdm

from labelgen.printable import printable

__all__ = ["progress_bar"]

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
