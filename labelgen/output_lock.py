"""A lock on an output, so that two jobs never write into one place."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import IO

from labelgen.atomic_files import as_output_error
from labelgen.errors import OutputError

try:
    import fcntl
except ImportError:  # not on Windows, where two jobs are not kept apart
    fcntl = None  # type: ignore[assignment]

__all__ = ["take_lock"]

_MAX_TRIES = 20


def take_lock(path: Path, out: Path) -> IO[str]:
    """Make and lock a file; it stays locked until the returned file is closed or the process ends.

    Args:
        path: of the lock; its folder is made where it is missing. Whoever holds the lock may delete file and folder.
        out: what is written, for the message.

    Raises:
        OutputError: another job holds it, the name is taken by something else, or it cannot be written.
    """
    for _ in range(_MAX_TRIES):
        with as_output_error(out):
            with contextlib.suppress(FileExistsError):
                path.parent.mkdir(parents=True)
            if path.is_symlink() or (path.exists() and not path.is_file()):
                raise OutputError(f"{path}: not a file that labelgen wrote; remove it", parameter="out")
            try:
                file = path.open("a")
            except FileNotFoundError:  # another job has ended in between and deleted the folder
                continue
        if not _lock(file):
            file.close()
            raise OutputError(
                f"out {out}: another labelgen job is writing into it; wait for it or choose another place",
                parameter="out",
            )
        # The file may have been deleted, and made anew by a third job, before it was locked here.
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()
    raise OutputError(f"out {out}: other labelgen jobs begin and end there; choose another place", parameter="out")


def _lock(file: IO[str]) -> bool:
    """Lock a file; return whether no other process holds it. File systems without locks keep nobody apart."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
