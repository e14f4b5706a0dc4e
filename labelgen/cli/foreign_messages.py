"""What C libraries write to standard error: messages about broken image data are counted, all else is passed on.

libpng and libjpeg write straight to file descriptor 2, from any thread, one line for each defect. So that descriptor is
a file while a command runs, and Python's own standard error keeps the terminal. A pipe would be too small: a library
that fills it waits for its reader, and with it all threads.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from typing import IO, Any

from labelgen.printable import printable
from labelgen.problem_counts import count_of

__all__ = ["counted_foreign_messages"]

_log = logging.getLogger(__name__)

_STDERR = 2
_BROKEN_IMAGE = re.compile(
    rb"libpng (?:warning|error)|Corrupt JPEG data|Premature end of JPEG file|Invalid (?:SOS|component|JPEG)"
    rb"|Unsupported marker type|Inconsistent progression|Warning: unknown JFIF|TIFF\w*: (?:Warning|Error)"
)
_POLL_S = 0.5


class _KeptTerminal:
    """A descriptor of standard error, one for the process: loggers of other libraries keep writing to it."""

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self.is_used = False

    def take(self) -> int:
        """Let the descriptor be the present standard error, and return it."""
        if self._descriptor is None:
            self._descriptor = os.dup(_STDERR)
        else:
            os.dup2(_STDERR, self._descriptor)
        return self._descriptor

    def __enter__(self) -> None:
        self.is_used = True

    def __exit__(self, *_: object) -> None:
        self.is_used = False


_kept = _KeptTerminal()


@contextmanager
def counted_foreign_messages() -> Iterator[None]:
    """Count the messages of image libraries in this block, and log them in one line at its end."""
    if _kept.is_used:  # within another such block
        yield
        return
    try:
        terminal = _kept.take()
    except OSError:  # there is no standard error
        yield
        return
    try:
        file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
    except OSError:  # no room for it
        yield
        return
    messages, ended = _Messages(file, terminal), threading.Event()
    poller = threading.Thread(target=messages.poll, args=(ended,), daemon=True)
    with file, _kept, _python_writes_to(terminal):
        sys.stderr.flush()
        # Processes that inherit the descriptor share its position: no line is written over another.
        os.dup2(file.fileno(), _STDERR)
        poller.start()
        try:
            yield
        finally:
            ended.set()
            poller.join()
            os.dup2(terminal, _STDERR)
            messages.take(last=True)
            messages.report()


@contextmanager
def _python_writes_to(terminal: int) -> Iterator[None]:
    """Let Python's standard error write to a descriptor, where it wrote to number 2."""
    stream: Any = sys.stderr
    try:
        is_standard = stream.fileno() == _STDERR
    except (AttributeError, OSError, ValueError):
        is_standard = False
    if not is_standard:
        yield
        return
    # It stays open: loggers of other libraries that were made meanwhile keep it.
    own = open(terminal, "w", encoding=stream.encoding, errors=stream.errors, buffering=1, closefd=False)  # noqa: SIM115
    if not faulthandler.is_enabled():
        # The last words of a library that ends the process would stay in the file.
        faulthandler.enable(own)
    with redirect_stderr(own):
        yield


class _Messages:
    """The lines that came into a file so far."""

    def __init__(self, file: IO[bytes], terminal: int) -> None:
        self._file, self._terminal = file, terminal
        self._place, self._rest = 0, b""
        self._count, self._example = 0, ""

    def poll(self, ended: threading.Event) -> None:
        """Take what comes until the end."""
        while not ended.wait(_POLL_S):
            self.take()

    def take(self, *, last: bool = False) -> None:
        """Count new lines about broken images; pass the others on."""
        data = b""
        while piece := os.pread(self._file.fileno(), 1 << 16, self._place):
            self._place += len(piece)
            data += piece
        *lines, self._rest = (self._rest + data).split(b"\n")
        if last and self._rest:
            lines, self._rest = [*lines, self._rest], b""
        other = []
        for line in lines:
            if _BROKEN_IMAGE.match(line):
                self._count += 1
                self._example = self._example or line.decode("utf-8", "replace").strip()
            else:
                other.append(line + b"\n")
        if other:
            os.write(self._terminal, b"".join(other))

    def report(self) -> None:
        """Log the count in one line."""
        if self._count:
            told = f"{count_of(self._count, 'message')} of image libraries about damaged images"
            _log.warning("%s, such as: %s", told, printable(self._example))
