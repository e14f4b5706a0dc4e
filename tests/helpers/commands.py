"""Running the `labelgen` command in the tests' own process."""

from __future__ import annotations

import contextlib
import io
import subprocess

from labelgen.cli.main import main

__all__ = ["run_labelgen"]


def run_labelgen(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command in the present folder; its exit code and what it printed."""
    words = [str(argument) for argument in arguments]
    out, err = io.StringIO(), io.StringIO()
    code: int | str | None = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as end:
            code = end.code
    return subprocess.CompletedProcess(words, int(code or 0), out.getvalue(), err.getvalue())
