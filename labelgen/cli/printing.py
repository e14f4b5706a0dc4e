"""Everything that the commands print goes through here."""

from __future__ import annotations

import typer

from labelgen.printable import hide_passwords, printable

__all__ = ["say"]


def say(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Print text in which nothing can steer the terminal, and no password of a URL stands.

    Args:
        text: may hold names of files and texts of inputs.
        err: whether it goes to standard error.
        nl: whether the line ends.
    """
    typer.echo(hide_passwords(printable(text, keep="\n")), err=err, nl=nl)
