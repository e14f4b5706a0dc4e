"""Notes and warnings of the library on standard error: few on the screen, all of them in a file beside the output."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from labelgen.printable import hide_passwords, printable

__all__ = [
    "LOGGERS",
    "NOTE_LIMITS",
    "NoteLimits",
    "finish_notes",
    "name_options",
    "notes_beside",
    "notes_on_screen",
    "options_in_notes",
]

LOGGERS = ("labelgen", "detector")
# Not only .log: that may be where the user's shell writes what is printed.
_SUFFIX = ".labelgen.log"
# Parameters that notes of the library name, and that no other word is like.
_NAMED_PARAMETERS = re.compile(r"(?<![\w./-])(first_frame|scale_masks|(?<=set )deinterlace)(?![\w./-])")


@dataclass(frozen=True)
class NoteLimits:
    """How many lines are shown and kept."""

    lines: int = 9
    """Notes and warnings on the screen, beside the line that says how many more there are."""
    notes: int = 5
    """Notes among them, so that there is room for warnings, which come later."""
    kept: int = 100_000
    """Lines in the file, so that the memory is bounded."""


NOTE_LIMITS = NoteLimits()


def name_options(text: str, options: Collection[str]) -> str:
    """Return text of the library in which the parameters that it names are options, where the command has them."""

    def named(match: re.Match[str]) -> str:
        option = f"--{match[1].replace('_', '-')}"
        return option if option in options else match[0]

    return _NAMED_PARAMETERS.sub(named, text)


class _Notes(logging.Handler):
    """Print each line once, up to the limits; keep them all."""

    def __init__(self, limits: NoteLimits) -> None:
        super().__init__()
        self.limits, self.output = limits, None
        self.options: Collection[str] = ()
        self._lines: dict[str, None] = {}
        self._shown = self._shown_notes = self._hidden = 0

    output: Path | None

    def emit(self, record: logging.LogRecord) -> None:
        """Print or keep a line; planning a job and doing it may log the same one twice."""
        word = "note" if record.levelno == logging.INFO else record.levelname.lower()
        line = hide_passwords(printable(f"{word}: {name_options(record.getMessage(), self.options)}"))
        if line in self._lines:
            return
        if len(self._lines) < self.limits.kept:
            self._lines[line] = None
        is_note = record.levelno < logging.WARNING
        full = self._shown >= self.limits.lines or (is_note and self._shown_notes >= self.limits.notes)
        if full and logging.getLogger(LOGGERS[0]).level != logging.DEBUG:
            self._hidden += 1
            return
        self._shown += 1
        self._shown_notes += is_note
        print(line, file=sys.stderr, flush=True)

    def finish(self) -> None:
        """Write the file where lines were left out, and say where it is."""
        if not self._hidden:
            return
        hidden, self._hidden = self._hidden, 0
        where = "labelgen --verbose shows them"
        if self.output is not None:
            path = self.output.absolute()
            path = path.parent / f"{path.name}{_SUFFIX}"
            with suppress(OSError, ValueError):
                path.write_text("".join(f"{line}\n" for line in self._lines), encoding="utf-8")
                where = f"all of them are in {path.name}, beside the output"
        more = "1 more line" if hidden == 1 else f"{hidden} more lines"
        print(printable(f"note: {more} like these; {where}"), file=sys.stderr, flush=True)


_running: list[_Notes] = []


@contextmanager
def notes_on_screen(limits: NoteLimits = NOTE_LIMITS) -> Iterator[None]:
    """Print what the library logs in this block, as lines with the word `note` or `warning` before them."""
    handler = _Notes(limits)
    loggers = [logging.getLogger(name) for name in LOGGERS]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.addHandler(handler)
    _running.append(handler)
    try:
        yield
    finally:
        handler.finish()
        _running.remove(handler)
        for logger, level in zip(loggers, levels, strict=True):
            logger.removeHandler(handler)
            logger.setLevel(level)


def options_in_notes(options: Collection[str]) -> None:
    """Say which options the command has: notes name no others."""
    for handler in _running[-1:]:
        handler.options = options


def notes_beside(output: Path) -> None:
    """Name the output of the command: notes that find no room on the screen go to OUTPUT.labelgen.log, beside it."""
    for handler in _running[-1:]:
        handler.output = output


def finish_notes() -> None:
    """Say how many notes found no room; called before the last line of a command."""
    for handler in _running[-1:]:
        handler.finish()
