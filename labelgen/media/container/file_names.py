"""Names of files as FFmpeg takes them."""

from __future__ import annotations

from pathlib import Path

from labelgen.errors import DataError

__all__ = ["ffmpeg_name"]


def ffmpeg_name(path: str | Path) -> str:
    """Return the name under which FFmpeg opens a file for reading or writing.

    The prefix keeps a colon in the path from being read as a protocol.

    Raises:
        DataError: FFmpeg takes no such name.
    """
    name = str(path)
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        shown = name.encode("utf-8", "backslashreplace").decode()
        raise DataError(f"{shown}: its name is not UTF-8; rename the file") from None
    if "\0" in name:
        raise DataError(f"{name!r}: its path is no file's name")
    return f"file:{name}"
