"""Ranges of bytes of a data set, read straight from the file where it lies there in one piece."""

from __future__ import annotations

import os

import h5py

__all__ = ["ByteStrip"]


class ByteStrip:
    """A one-dimensional uint8 data set of an open file.

    Shards are written in one piece, so a range of them is one read of the file: HDF5's own way to it takes as long as
    decoding a small picture, and one thread at a time. What another program has chunked or packed goes through HDF5.

    Args:
        dataset: it; its file stays open as long as this is used.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset, self._size = dataset, int(dataset.size)
        plain = dataset.file.driver == "sec2" and hasattr(os, "pread")
        self._start: int | None = dataset.id.get_offset() if plain else None
        self._handle = int(dataset.file.id.get_vfd_handle()) if self._start is not None else -1

    def read(self, start: int, stop: int) -> bytes:
        """The bytes from `start` to before `stop`.

        Raises:
            ValueError: no such range.
            OSError: the file cannot be read, or ends before.
        """
        if not 0 <= start <= stop <= self._size:
            raise ValueError(f"bytes {start} to {stop} of {self._size} asked for")
        if self._start is None:
            packed: bytes = self._dataset[start:stop].tobytes()
            return packed
        data = os.pread(self._handle, stop - start, self._start + start)
        if len(data) < stop - start:
            raise OSError("the file ends within an image")
        return data
