"""Everything that the commands print goes through here."""

from __future__ import annotations

import typer

from labelgen.printable import hide_passwords, printable

__all__ = ["EndedBySignalError", "say"]


class EndedBySignalError(Exception):
    """Ctrl-C or SIGTERM ended a command.

    Args:
        number: of the signal; the exit code is 128 more.
        text: what there is to say of what was made so far.
    """

    def __init__(self, number: int, text: str = "") -> None:
        super().__init__(text)
        self.signal = number


def say(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Print text in which nothing can steer the terminal, and no password of a URL stands.

    Args:
        text: may hold names of files and texts of inputs.
        err: whether it goes to standard error.
        nl: whether the line ends.
    """
    typer.echo(hide_passwords(printable(text, keep="\n")), err=err, nl=nl)
