"""Files that grow record by record and are whole after each of them, whatever happens next.

A result file is one JSON object, so each new car is written over the closing bracket, which follows it again. When the
disk fills, the half-written record is taken back: what was there before stays readable.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType

from labelgen.atomic_files import as_output_error

__all__ = ["AppendFile"]


class AppendFile:
    """Context manager for a file of `head record separator record ... tail`.

    Args:
        path: replaced if it exists.
        head, separator, tail: text around the records.

    Raises:
        OutputError: the file cannot be made or grown; records written before are still there.
    """

    def __init__(self, path: Path, *, head: str = "", separator: str = "", tail: str = "") -> None:
        self.path, self.count = path, 0
        self._separator, self._tail = separator.encode(), tail.encode()
        with as_output_error(path):
            self._file = path.open("wb", buffering=0)
            self._end = 0
            try:
                self._write(head.encode())
            except OSError:
                self._file.close()
                raise

    def add(self, record: str) -> None:
        """Write one more record; it is in the operating system's hands when this returns."""
        with as_output_error(self.path):
            self._write((self._separator if self.count else b"") + record.encode())
        self.count += 1

    def _write(self, data: bytes) -> None:
        """Put data before the tail, or leave the file as it was."""
        end = self._end
        try:
            self._put(data + self._tail, end)
        except OSError:
            os.truncate(self._file.fileno(), end)
            if self.count or end:
                self._put(self._tail, end)
            raise
        self._end = end + len(data)

    def _put(self, data: bytes, at: int) -> None:
        done = 0
        while done < len(data):
            done += os.pwrite(self._file.fileno(), data[done:], at + done)

    def __enter__(self) -> AppendFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            with as_output_error(self.path):
                os.fsync(self._file.fileno())
        self._file.close()
