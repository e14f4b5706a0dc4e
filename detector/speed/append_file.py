"""Files that grow by one record at a time and can be read after each of them.

A result file is one JSON object: each new car is written over the closing bracket, and the bracket is written again
after it. If the disk is full, the incomplete record is removed, and the records before stay readable.
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
        path: of the file; replaced if it exists.
        head, separator, tail: text before, between and after the records.

    Attributes:
        count: number of records written.

    Raises:
        OutputError: the file cannot be made or extended; records written before are still in it.
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
        """Write one more record. The operating system has it when this returns; it may not be on the disk yet.

        Raises:
            OutputError: the record cannot be written; the file is as before.
        """
        with as_output_error(self.path):
            self._write((self._separator if self.count else b"") + record.encode())
        self.count += 1

    def _write(self, data: bytes) -> None:
        """Write data before the tail, or leave the file as it was."""
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
        written = 0
        while written < len(data):
            written += os.pwrite(self._file.fileno(), data[written:], at + written)

    def __enter__(self) -> AppendFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            with as_output_error(self.path):
                os.fsync(self._file.fileno())
        self._file.close()
