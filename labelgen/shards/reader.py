"""Reading one shard. Files are opened at the first access, in each process anew."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from labelgen.choices import Pair, parse_size
from labelgen.errors import DataError
from labelgen.geometry.camera import Camera
from labelgen.geometry.rectification import Rectification
from labelgen.json_file import parse_json
from labelgen.labels import IgnoredBoxes, Labels, Sample, Split
from labelgen.shards.layout import (
    DAMAGE,
    check_attributes,
    check_fields,
    check_values,
    open_shard_file,
    read_attributes,
    read_fields,
)
from labelgen.shards.rejects import Reject, from_json_lines
from labelgen.shards.schema import IMAGES

__all__ = ["ByteStrip", "ShardReader"]

_STALE_AFTER_UNPICKLING = ("_tables", "_labels", "_ignored", "attributes")


class ShardReader:
    """One shard as a sequence of samples.

    Its file is opened at the first access, anew in each process, so that readers can be pickled and forked. All fields
    but the images are then read at once and kept in memory.

    Args:
        path: the shard.

    Attributes:
        path: the shard.

    Raises:
        DataError: at the first access: the file is missing, not a shard, damaged, or of a newer format.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._pid = 0
        self._images: ByteStrip | None = None

    def __enter__(self) -> ShardReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        state = {key: value for key, value in self.__dict__.items() if key not in _STALE_AFTER_UNPICKLING}
        return {**state, "_file": None, "_pid": 0, "_images": None}

    def close(self) -> None:
        """Close the file; the next access opens it again."""
        if self._file is not None and self._pid == os.getpid():
            self._file.close()
        self._file = self._images = None

    def _open(self) -> h5py.File:
        # A handle that came through fork() shares its file position with the parent: open our own.
        if self._file is None or self._pid != os.getpid():
            self._file = open_shard_file(self.path)
            self._pid = os.getpid()
            self._images = None
        return self._file

    # -- attributes and fields ------------------------------------------------------------------------

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """Format, version, pair, size, source, part, settings and content hash."""
        file = self._open()
        with self._damage():
            values = read_attributes(file)
        problems = check_attributes(values)
        if problems:
            raise DataError(f"{self.path}: {problems[0]}")
        problems = check_fields(file, values["version"], self._file_bytes())
        if problems:
            raise DataError(f"{self.path}: damaged, {problems[0]}; make it again")
        return values

    def _file_bytes(self) -> int:
        return self.path.stat().st_size

    @contextlib.contextmanager
    def _damage(self) -> Iterator[None]:
        """Turn what HDF5 and the parsers raise on damaged content into a DataError that names the file."""
        try:
            yield
        except DAMAGE as err:
            reason = " ".join(str(err).split()) or type(err).__name__
            raise DataError(f"{self.path}: damaged ({reason}); make it again") from None

    @property
    def pair(self) -> Pair:
        """Vanishing-point pair of all samples."""
        text = self.attributes["pair"]
        with self._damage():
            return Pair.parse(text)

    @property
    def size_wh(self) -> tuple[int, int]:
        """Size of all images, px."""
        text = self.attributes["size"]
        with self._damage():
            return parse_size(text)

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the labels, as plain values."""
        with self._damage():
            return dict(parse_json(self.attributes["settings"]))

    @cached_property
    def _tables(self) -> dict[str, NDArray[Any]]:
        version = self.attributes["version"]  # checks the format before anything is read
        file = self._open()
        with self._damage():
            tables = read_fields(file, version, self._file_bytes(), without=(IMAGES,))
            problems = check_values(tables, len(file[IMAGES]), self.settings)
        if problems:
            raise DataError(f"{self.path}: damaged, {problems[0]}; make it again")
        return tables

    def read_all(self) -> dict[str, NDArray[Any]]:
        """Return all fields by their names, "images/bytes" included; those that an older version lacks are neutral."""
        version, file = self.attributes["version"], self._open()
        with self._damage():
            return read_fields(file, version, self._file_bytes())

    def table(self, name: str) -> NDArray[Any]:
        """Return a whole field by its name in the format, for instance "labels/cc"."""
        return self._tables[name]

    def __len__(self) -> int:
        return len(self.table("samples/frame"))

    @property
    def label_count(self) -> int:
        """Number of labels in the shard."""
        return len(self.table("labels/cc"))

    @cached_property
    def rejects(self) -> list[Reject]:
        """The inputs of this shard without a label."""
        with self._damage():
            return from_json_lines(self.table("rejects").tobytes())

    @cached_property
    def cameras(self) -> list[Camera]:
        """The cameras of all samples, each once."""
        rows = zip(
            *(self.table(f"cameras/{key}") for key in ("vp1", "vp2", "pp", "scale", "size", "name")), strict=True
        )
        with self._damage():
            return [
                Camera(vp1, vp2, pp, None if np.isnan(scale) else float(scale), _size(size), str(name))
                for vp1, vp2, pp, scale, size, name in rows
            ]

    def camera(self, index: int) -> Camera:
        """Return the camera of one sample."""
        return self.cameras[int(self.table("samples/camera")[index])]

    # -- samples ------------------------------------------------------------------------------------

    def labels(self, index: int) -> Labels:
        """Return the labels of one sample."""
        start, stop = self.table("labels/offset")[index : index + 2].tolist()
        return self._labels[start:stop]

    @cached_property
    def _labels(self) -> Labels:
        """The labels of all samples, validated once for the whole shard."""
        names = ("box", "cc", "class", "score", "flags", "candidates", "sigma", "hidden")
        try:
            return Labels(*(self.table(f"labels/{name}") for name in names))
        except DataError as err:
            raise DataError(f"{self.path}: damaged ({err}); make it again") from None

    def ignored(self, index: int) -> IgnoredBoxes:
        """Return the boxes of one sample that hold a vehicle without a label."""
        start, stop = self.table("ignored/offset")[index : index + 2].tolist()
        return self._ignored[start:stop]

    @cached_property
    def _ignored(self) -> IgnoredBoxes:
        """The ignored boxes of all samples, validated once for the whole shard."""
        return IgnoredBoxes(self.table("ignored/box"), self.table("ignored/reason"))

    def encoded(self, index: int) -> bytes:
        """Return the JPEG or PNG bytes of one sample's image."""
        start, stop = self.table("images/offset")[index : index + 2].tolist()
        file = self._open()
        with self._damage():
            if self._images is None:
                # HDF5 takes as long to look a data set up as to read an image from it.
                self._images = ByteStrip(file[IMAGES])
            return self._images.read(start, stop)

    def rectification(self, index: int) -> Rectification:
        """Return the rectification of one sample, from the original frame."""
        camera = self.camera(index)
        matrix, vpu = self.table("samples/matrix")[index], self.table("samples/vpu")[index]
        with self._damage():
            return Rectification(self.pair, self.size_wh, matrix, vpu, camera.image_wh)

    def __getitem__(self, index: int) -> Sample:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path}: sample {index} of {len(self)}")
        index %= len(self)
        return Sample(
            self.encoded(index),
            self.labels(index),
            self.rectification(index),
            self.camera(index),
            str(self.table("samples/source")[index]),
            int(self.table("samples/frame")[index]),
            float(self.table("samples/time")[index]),
            Split(int(self.table("samples/split")[index])),
            self.table("samples/window")[index],
            self.ignored(index),
        )

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(len(self)))


def _size(size: NDArray[np.int32]) -> tuple[int, int] | None:
    return (int(size[0]), int(size[1])) if size.all() else None


class ByteStrip:
    """A one-dimensional uint8 HDF5 data set, read by ranges of bytes.

    A contiguous data set is read from the file itself: HDF5 takes as long for it as the decoding of a small image, and
    serves one thread at a time. A chunked or compressed data set is read through HDF5.

    Args:
        dataset: the data set; its file must stay open.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset, self._size = dataset, int(dataset.size)
        plain = dataset.file.driver == "sec2" and hasattr(os, "pread")
        self._start: int | None = dataset.id.get_offset() if plain else None
        self._handle = int(dataset.file.id.get_vfd_handle()) if self._start is not None else -1

    def read(self, start: int, stop: int) -> bytes:
        """Return the bytes from `start` to before `stop`.

        Raises:
            ValueError: no such range.
            OSError: the file cannot be read, or ends within the range.
        """
        if not 0 <= start <= stop <= self._size:
            raise ValueError(f"bytes {start} to {stop} of {self._size} asked for")
        if self._start is None:
            content: bytes = self._dataset[start:stop].tobytes()
            return content
        data = os.pread(self._handle, stop - start, self._start + start)
        if len(data) < stop - start:
            raise OSError("the file ends within an image")
        return data
