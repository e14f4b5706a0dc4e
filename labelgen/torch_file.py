"""Read files of `torch.save` that hold tensors and plain values; what a damaged or hostile one may cost is bounded.

PyTorch reads tensors without running code (`weights_only`), but trusts what the file says of its own sizes. Before it
is loaded, the pickles inside are scanned, and every tensor's stated size is compared with the bytes that are stored.

Source: PyTorch, `torch.serialization` (zip files with `data.pkl` and one record for each storage; older files are
five pickles and raw storages).
"""

from __future__ import annotations

import io
import pickle
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from labelgen.datasets.pickle_scan import PickleLimits, scan_pickle
from labelgen.errors import DataError

__all__ = ["first_not_finite", "load_torch_file"]

_DAMAGE = (
    pickle.UnpicklingError, zipfile.BadZipFile, zlib.error, struct.error, RuntimeError, EOFError, ArithmeticError,
    AssertionError, AttributeError, BufferError, ImportError, LookupError, MemoryError, TypeError, ValueError,
)  # fmt: skip
# A training's file has one entry for each tensor, optimiser state and setting: few bytes beside the tensors.
_LIMITS = PickleLimits()
_OLD_PICKLES = 5
_MAX_DEPTH, _MAX_REASON = 30, 120
_ITEM_BYTES = {
    "DoubleStorage": 8, "FloatStorage": 4, "HalfStorage": 2, "BFloat16Storage": 2, "LongStorage": 8, "IntStorage": 4,
    "ShortStorage": 2, "CharStorage": 1, "ByteStorage": 1, "BoolStorage": 1, "UntypedStorage": 1,
    "ComplexFloatStorage": 8, "ComplexDoubleStorage": 16,
}  # fmt: skip


def load_torch_file(path: str | Path, label: str, *, parameter: str | None = None) -> Any:
    """Read a file of tensors and plain values, on the CPU.

    Args:
        path: the file.
        label: what it is and its path, for errors.
        parameter: name of the caller's parameter, for errors.

    Raises:
        DataError: no such file, damaged, with anything else inside, or with tensors larger than what is stored.
    """
    path = Path(path)
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataError(f"{label}: not a regular file", parameter=parameter)
        with path.open("rb") as file:
            size = path.stat().st_size
            if zipfile.is_zipfile(file):
                _check_zip(file, size)
            else:
                _check_old(file)
        data = torch.load(path, map_location="cpu", weights_only=True)
        _check_tensors(data)
    except OSError as err:
        raise DataError(f"{label}: {err.strerror or err}", parameter=parameter) from None
    except DataError as err:
        if str(err).startswith(label):
            raise
        raise DataError(f"{label}: refused: {err}", parameter=parameter) from None
    except _DAMAGE as err:
        raise DataError(
            f"{label}: not a whole file of PyTorch tensors and plain values ({_reason(err)})", parameter=parameter
        ) from None
    return data


def _reason(err: Exception) -> str:
    text = " ".join(str(err).split())
    if "Weights only load failed" in text:  # the rest is advice to load the file unsafely
        name = re.search(r"GLOBAL (\S+)", text)
        return f"it asks for {name[1]}, which is not data" if name else "it is damaged"
    return text[:_MAX_REASON] or type(err).__name__


def first_not_finite(state: Mapping[str, Any]) -> str | None:
    """Return the name of the first tensor with a value that is not finite; None where there is none."""
    for name, value in state.items():
        numbers = isinstance(value, torch.Tensor) and (value.is_floating_point() or value.is_complex())
        if numbers and not bool(torch.isfinite(value).all()):
            return str(name)
    return None


def _check_zip(file: Any, size: int) -> None:
    """Check a zip file as torch writes it: stored records, none larger than the file, and sane pickles."""
    with zipfile.ZipFile(file) as archive:
        records = {info.filename: info for info in archive.infolist()}
        if any(info.compress_type != zipfile.ZIP_STORED for info in records.values()):
            raise DataError("its records are compressed, which PyTorch does not do")
        if sum(info.file_size for info in records.values()) > size:
            raise DataError("its records are larger than the file")
        for name, info in records.items():
            if not name.endswith("data.pkl"):
                continue
            content = archive.read(info)
            scan_pickle(content, _LIMITS, persistent=True)
            _Storages(
                content, {key: other.file_size for key, other in records.items()}, name[: -len("data.pkl")]
            ).load()


def _check_old(file: Any) -> None:
    """Check the pickles of a file of the time before zip files."""
    content = file.read()
    at = 0
    for _ in range(_OLD_PICKLES):
        at = scan_pickle(content, _LIMITS, start=at, persistent=True)


class _Inert(dict):  # type: ignore[type-arg]
    """What stands for every object while the storages are looked at: it does nothing."""

    __hash__ = object.__hash__  # type: ignore[assignment]

    def __init__(self, *_: Any) -> None:
        super().__init__()

    def __setstate__(self, state: Any) -> None:
        """Ignore the state."""

    def append(self, value: Any) -> None:
        """Ignore a value."""

    add = append

    def extend(self, values: Any) -> None:
        """Ignore values."""


class _Name:
    """A name in a pickle; called, it does nothing."""

    __slots__ = ("name",)

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, *_: Any) -> _Inert:
        return _Inert()

    def __setstate__(self, state: Any) -> None:
        """Ignore the state."""


class _Storages(pickle.Unpickler):
    """Reads a pickle without making anything of it but the sizes of the storages that it names.

    Args:
        content: the pickle.
        sizes: bytes of each record of the file.
        folder: of the records, with a slash at its end.
    """

    def __init__(self, content: bytes, sizes: Mapping[str, int], folder: str) -> None:
        super().__init__(io.BytesIO(content))
        self._sizes, self._folder = sizes, folder

    def find_class(self, module: str, name: str) -> Any:
        return _Name(name)

    def persistent_load(self, pid: Any) -> Any:
        """Check the size of a storage.

        Raises:
            DataError: it is not the size of its record.
        """
        if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _Name)):
            raise DataError("it names a value that is no storage")
        _, kind, key, _, count = pid
        item = _ITEM_BYTES.get(kind.name)
        if item is None or type(count) is not int or count < 0:
            raise DataError("a storage of it has no known type and size")
        if self._sizes.get(f"{self._folder}data/{key}") != count * item:
            raise DataError("the size of a storage is not what it says")
        return _Inert()


def _check_tensors(data: Any) -> None:
    """Refuse tensors that stand for more values than are stored, and values nested too deep to walk through."""
    for value in _walk(data):
        if isinstance(value, torch.Tensor):
            if value.layout is not torch.strided or value.device.type != "cpu":
                raise DataError("it holds a tensor that is not stored value by value")
            if value.numel() * value.element_size() > value.untyped_storage().nbytes():
                raise DataError("it holds a tensor of more values than are stored")


def _walk(data: Any) -> Iterator[Any]:
    seen: dict[int, Any] = {}
    pending = [(data, 0)]
    while pending:
        value, depth = pending.pop()
        if depth > _MAX_DEPTH:
            raise DataError("its values are nested too deep")
        yield value
        if isinstance(value, dict | list | tuple | set | frozenset) and id(value) not in seen:
            seen[id(value)] = value
            parts = value.values() if isinstance(value, dict) else value
            pending += [(part, depth + 1) for part in parts]
