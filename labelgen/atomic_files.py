"""Atomic files: a reader sees the whole file or none."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from labelgen.errors import OutputError

__all__ = [
    "TEMPORARY_PREFIX",
    "as_output_error",
    "make_folder",
    "remove_temporary_files",
    "sync_file",
    "sync_folder",
    "write_atomic",
    "write_json",
]

TEMPORARY_PREFIX = ".labelgen-"

_ADVICE = {
    errno.ENOSPC: "no space left on the device; free some, then run it again",
    errno.EDQUOT: "disk quota exceeded; free some space, then run it again",
    errno.EFBIG: "file too large for the file system or the set limit",
    errno.EACCES: "permission denied; choose another place or change its permissions",
    errno.EMFILE: "too many open files; raise the limit (ulimit -n)",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EROFS: "read-only file system; choose another place",
}


@contextlib.contextmanager
def as_output_error(path: Path) -> Iterator[None]:
    """Turn an OSError of the block into an OutputError that names a file and says how to mend it.

    Args:
        path: the file that the block writes.

    Raises:
        OutputError: the block raised an OSError.
    """
    try:
        yield
    except OSError as err:
        reason = _ADVICE.get(err.errno or 0, err.strerror or str(err))
        raise OutputError(f"cannot write {path}: {reason}") from None


def make_folder(path: Path) -> Path:
    """Create a folder with its parents and return it.

    Raises:
        OutputError: it cannot be created.
    """
    with as_output_error(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


def write_atomic(path: Path, data: bytes | memoryview) -> None:
    """Write a whole file or nothing: to a temporary file, which is flushed to disk and renamed.

    Args:
        path: the file; a link is followed, and a device or pipe is written to directly.
        data: its content.

    Raises:
        OutputError: it cannot be written; nothing is left behind.
    """
    with as_output_error(path):
        if path.is_symlink():
            path = path.resolve()
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)  # a device or a pipe must not be replaced
            return
        handle, temporary = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, suffix=".tmp", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(temporary, 0o666 & ~umask)
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        sync_folder(path.parent)


def sync_file(path: Path) -> None:
    """Flush a file to disk.

    Raises:
        OSError: it cannot be written.
    """
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Flush a folder to disk, so that a rename survives a power cut, where the system supports it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file atomically, with keys in the given order.

    Raises:
        OutputError: it cannot be written.
    """
    write_atomic(path, (json.dumps(data, indent=2, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace"))


def remove_temporary_files(folder: Path) -> None:
    """Delete the temporary files that killed writers left in a folder."""
    for path in folder.glob(f"{TEMPORARY_PREFIX}*.tmp"):
        with contextlib.suppress(OSError):
            path.unlink()
