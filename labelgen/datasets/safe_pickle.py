"""Load data sets that are published as pickles, without running code from them.

Loading a pickle calls the functions that it names. Here only the constructors that plain data and NumPy arrays need
are allowed, and each of them is replaced by a function of this module. Any other name stops the loading before
anything is called. NumPy's own constructors are never called, because a pickle can make them take bytes for pointers.
The replacements collect the parts of an array; its bytes become an array of numbers or text after they are checked.

Loading may take memory and time in proportion to the file's size only. `labelgen.datasets.pickle_scan` checks the
instructions beforehand; here, what calls make and how often values are shared is counted.

Source: the Python standard library, `pickle` ("Restricting Globals"); NumPy's `ndarray.__reduce__` (parts of an array).
"""

from __future__ import annotations

import contextvars
import math
import mmap
import pickle
import re
import stat
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.pickle_scan import PickleLimits, scan_pickle
from labelgen.errors import DataError

__all__ = ["load_pickle"]

# Type codes of NumPy without pointers, names or fields, and "O" for Python objects.
_PLAIN = re.compile(r"[<>|=]?(b1|[iu][1248]|f(2|4|8|12|16)|c(8|16|24|32)|[SU][1-9][0-9]{0,8}|O[48]?)")

_BASE_ITEMS = 1_000_000
"""Bytes or parts that a file of any size may give beyond those in proportion to its size."""
_ITEMS_PER_BYTE = 8
_limits = PickleLimits()


class _Budget:
    """Bytes that a file's calls may still make: one value, made again and again, fills the memory.

    Args:
        file_bytes: size of the file.
    """

    def __init__(self, file_bytes: int) -> None:
        self.left = _BASE_ITEMS + _ITEMS_PER_BYTE * file_bytes

    def spend(self, count: int) -> None:
        """Take bytes; refuse more than there are."""
        self.left -= count
        if self.left < 0:
            raise DataError("it makes far more of its values than a file of its size holds")


_budget: contextvars.ContextVar[_Budget] = contextvars.ContextVar("_budget")


class _DType:
    """A NumPy data type as the pickle describes it."""

    __slots__ = ("type",)

    def __init__(self, code: Any = None, align: Any = False, copy: Any = True) -> None:
        if not isinstance(code, str) or not _PLAIN.fullmatch(code):
            raise DataError(f"it holds an array of {code!r}, which is neither numbers nor text")
        self.type: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        """Set the byte order; alignment and flags follow from the type."""
        if not (isinstance(state, tuple) and len(state) == 8 and state[1] in ("<", ">", "|", "=")):
            raise DataError("an array's type is not described the way NumPy writes it")
        if any(part is not None for part in state[2:5]) or state[5] not in (-1, self.type.itemsize):
            raise DataError("an array's type has parts or a size of its own")
        self.type = self.type.newbyteorder(state[1])


class _Array:
    """An array as the pickle describes it; `load_pickle` replaces it by its `content`."""

    __slots__ = ("content",)
    __hash__ = None  # type: ignore[assignment]  # as an array's

    def __init__(self, kind: Any, shape: Any, dtype: Any) -> None:
        if not isinstance(kind, _Replacement) or kind.name != "ndarray" or shape != (0,):
            raise DataError("an array is not built the way NumPy writes it")
        self.content: NDArray[Any] | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise DataError("an array is not filled the way NumPy writes it")
        _, shape, dtype, fortran, content = state
        if isinstance(dtype, _DType) and dtype.type.kind == "O":
            self.content = _objects(content, shape)
        else:
            self.content = _numbers(content, dtype, shape, "F" if fortran is True else "C")


def _numbers(content: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    """Return an array of a plain type from raw bytes; refuse bytes that are no values of the type."""
    if isinstance(content, str):  # Python 2's bytes
        content = _latin1_bytes(content)
    if not isinstance(dtype, _DType) or dtype.type.kind == "O" or not isinstance(content, bytes | bytearray):
        raise DataError("an array's content does not fit its type")
    if len(content) != _item_count(shape) * dtype.type.itemsize or order not in ("C", "F"):
        raise DataError("an array's content does not fit its size")
    _budget.get().spend(len(content))
    array = np.ndarray(shape, dtype.type, bytes(content), order=order).copy(order=order)
    if dtype.type.kind == "b" and (array.view(np.uint8) > 1).any():
        raise DataError("an array of truth values holds others")
    if dtype.type.kind == "U" and array.size:
        points = np.frombuffer(content, np.dtype(np.uint32).newbyteorder(dtype.type.byteorder))
        if points.max() > 0x10FFFF:
            raise DataError("an array of text holds what are no characters")
    return array


def _objects(content: Any, shape: Any) -> NDArray[Any]:
    """Return an array of Python objects from a list of them."""
    if not isinstance(content, list) or len(content) != _item_count(shape):
        raise DataError("an array of objects is not filled with a list of its size")
    _budget.get().spend(8 * len(content))
    array = np.empty(len(content), dtype=object)
    for i, item in enumerate(content):
        array[i] = item
    return array.reshape(shape)


def _item_count(shape: Any) -> int:
    if not isinstance(shape, tuple) or len(shape) > 32 or not all(type(n) is int and n >= 0 for n in shape):
        raise DataError("an array's shape is not a tuple of sizes")
    return math.prod(shape)


def _scalar(dtype: Any, content: Any) -> Any:
    """Replace NumPy's `scalar`: one number or text."""
    return _numbers(content, dtype, (1,), "C")[0]


def _frombuffer(content: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> NDArray[Any]:
    """Replace NumPy's `_frombuffer`, which protocol 5 uses."""
    if order == "K" and isinstance(axes, tuple):
        return _numbers(content, dtype, shape, "C").transpose(axes)
    return _numbers(content, dtype, shape, order)


def _latin1_bytes(text: Any, encoding: Any = "latin1") -> bytes:
    """Replace `_codecs.encode`, by which Python 3 stores bytes in old protocols."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise DataError(f"a bytes value asks for the codec {str(encoding)[:40]!r}")
    _budget.get().spend(len(text))
    return text.encode("latin-1")


def _bytes(*arguments: Any) -> bytes:
    """Replace `bytes`, by which old protocols store empty bytes."""
    if arguments:
        raise DataError("a bytes value is made of something else")
    return b""


def _bytearray(content: Any = b"", encoding: Any = "latin1") -> bytearray:
    """Replace `bytearray`, which given a large number would fill the memory."""
    if isinstance(content, str):
        content = _latin1_bytes(content, encoding)
    if not isinstance(content, bytes | bytearray):
        raise DataError(f"a bytearray is made of {type(content).__name__}")
    _budget.get().spend(len(content))
    return bytearray(content)


def _set(content: Any = ()) -> set[Any]:
    """Replace `set`: refuse elements whose hash would take long."""
    if not isinstance(content, list | tuple | set | frozenset):
        raise DataError(f"a set is made of {type(content).__name__}")
    _budget.get().spend(8 * len(content))
    for item in content:
        _check_element(item)
    return set(content)


def _frozenset(content: Any = ()) -> frozenset[Any]:
    """Replace `frozenset`."""
    return frozenset(_set(content))


def _check_element(item: Any) -> None:
    """Refuse an element of very many parts; parts that are shared count each time."""
    pending, count = [item], 0
    while pending:
        part = pending.pop()
        count += 1
        if count > _limits.key_parts or (isinstance(part, int) and part.bit_length() > 64):
            raise DataError("a set has an element of very many parts, or a very long number")
        if isinstance(part, tuple):
            pending += part[: _limits.key_parts]


def _no_array(*arguments: Any) -> Any:
    raise DataError("an array is not built the way NumPy writes it")


class _Replacement:
    """A function that a pickle may call. Unlike a plain function, it has no attributes that a pickle can set."""

    __slots__ = ("_function", "name")

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        self.name = name
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise DataError(f"it sets the state of {self.name}, which has none")


_BUILTINS = {
    "set": _Replacement("set", _set),
    "frozenset": _Replacement("frozenset", _frozenset),
    "complex": complex,
    "bytearray": _Replacement("bytearray", _bytearray),
    "bytes": _Replacement("bytes", _bytes),
}
_NUMPY = {"ndarray": _Replacement("ndarray", _no_array), "dtype": _Replacement("dtype", _DType)}
_CORE = {
    "multiarray._reconstruct": _Replacement("_reconstruct", _Array),
    "multiarray.scalar": _Replacement("scalar", _scalar),
    "numeric._frombuffer": _Replacement("_frombuffer", _frombuffer),
}
_ENCODE = _Replacement("encode", _latin1_bytes)


def _allowed(module: str, name: str) -> Any:
    """Return the replacement for a name in a module; None where the name is not allowed."""
    if module in ("builtins", "__builtin__"):
        return _BUILTINS.get(name)
    if module == "numpy":
        return _NUMPY.get(name)
    if (module, name) == ("_codecs", "encode"):
        return _ENCODE
    # NumPy has renamed its core package; old pickles hold the old name.
    core = module.removeprefix("numpy._core.").removeprefix("numpy.core.")
    return _CORE.get(f"{core}.{name}") if core != module else None


class _DataUnpickler(pickle.Unpickler):
    """An unpickler that only calls the replacements of this module."""

    def find_class(self, module: str, name: str) -> Any:
        replacement = _allowed(module, name)
        if replacement is None:
            raise DataError(f"it asks for {module}.{name}, which is not data")
        return replacement


class _Finish:
    """Replaces every `_Array` and `_DType` in a value by what it stands for; lists and dicts are changed in place.

    Values that hold themselves, or that share parts so often that walking through them takes long, are refused: code
    that reads data walks through all of it.

    Args:
        most_parts: largest number of parts, those that are shared counted each time.
    """

    def __init__(self, most_parts: int) -> None:
        self._most_parts = most_parts
        # Value, result and number of parts by the value's id. Holding the value keeps its id from being used again.
        self._results: dict[int, tuple[Any, Any, int]] = {}

    def __call__(self, value: Any) -> tuple[Any, int]:
        """Return the result and its number of parts."""
        kind = type(value)
        if kind is _DType:
            return value.type, 1
        if kind not in (list, dict, tuple, _Array):
            return value, 1
        if id(value) in self._results:
            _, result, parts = self._results[id(value)]
            if not parts:
                raise DataError("it holds a value that holds itself")
            return result, parts
        self._results[id(value)] = value, value, 0
        result, parts = self._array(value) if kind is _Array else self._container(value)
        if parts > self._most_parts:
            raise DataError("its values share parts so often that a file of its size cannot be read in time")
        self._results[id(value)] = value, result, parts
        return result, parts

    def _array(self, value: _Array) -> tuple[Any, int]:
        content = value.content
        if content is None:
            raise DataError("an array is not filled the way NumPy writes it")
        parts = 1
        if content.dtype.kind == "O":
            flat = content.reshape(-1)
            for i, item in enumerate(flat):
                flat[i], count = self(item)
                parts += count
        return content, parts

    def _container(self, value: Any) -> tuple[Any, int]:
        parts = 1
        if type(value) is tuple:
            items = []
            for item in value:
                result, count = self(item)
                items.append(result)
                parts += count
            return tuple(items), parts
        for key, item in value.items() if type(value) is dict else enumerate(value):
            result, count = self(item)
            if result is not item:
                value[key] = result
            parts += count
        return value, parts


def load_pickle(path: str | Path) -> Any:
    """Load a pickle that holds only plain data and NumPy arrays, written by Python 2 (as latin-1) or 3.

    Arrays may hold truth values, numbers, text, bytes or Python objects; arrays of records and dates are refused, and
    so is what would take far more memory or time than the file's size lets expect.

    Args:
        path: the file.

    Raises:
        DataError: there is no such file, it is damaged, or it holds anything but data. No code in it is run.
    """
    path = Path(path)
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataError(f"{path}: not a regular file")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as err:
        raise DataError(f"{path}: {err.strerror or err}") from None
    except ValueError:
        raise DataError(f"{path!s:.200}: its path is no file's name") from None
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            if size == 0:
                raise EOFError("it is empty")
            # Mapped, because an atlas of pictures may take much of the memory.
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                scan_pickle(data, _limits)
            _budget.set(_Budget(size))
            value = _DataUnpickler(file, encoding="latin-1").load()
            return _Finish(_BASE_ITEMS + _ITEMS_PER_BYTE * size)(value)[0]
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as err:
        raise DataError(f"{path}: {err.strerror or err}") from None
    except DataError as err:
        detail = _one_line(str(err))
        raise DataError(f"{path}: refused, nothing was run: {detail}; get the file from its publisher again") from None
    except (
        pickle.UnpicklingError, EOFError, AttributeError, ImportError, LookupError, TypeError, ValueError,
        MemoryError, OverflowError, RecursionError, struct.error,
    ) as err:  # fmt: skip
        detail = _one_line(str(err)) or type(err).__name__
        raise DataError(f"{path}: not a readable pickle ({detail}); get the file from its publisher again") from None


def _one_line(text: str) -> str:
    """Return text from a file in one line of at most about 200 characters."""
    safe = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    return safe if len(safe) <= 200 else safe[:200] + "..."
