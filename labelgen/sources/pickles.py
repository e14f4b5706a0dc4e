"""Reading data sets that come as pickles, without trusting them.

A pickle is a program. Only the handful of constructors that plain data and NumPy arrays need are allowed;
anything else stops the reading before it is called.
"""

from __future__ import annotations

import importlib
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np

from labelgen.errors import DataError

__all__ = ["load_pickle"]


def _latin1_bytes(text: str, encoding: str = "latin1") -> bytes:
    """Stand-in for `_codecs.encode`, which Python 3 calls to store bytes in old protocols."""
    if encoding.replace("-", "").replace("_", "").lower() not in ("latin1", "iso88591"):
        raise DataError(f"a bytes value asks for the codec {encoding!r}")
    return text.encode("latin-1")


def _bytearray(content: Any = b"", encoding: str = "latin1") -> bytearray:
    """Stand-in for `bytearray`, which would take a number and fill the memory."""
    if isinstance(content, str):
        content = _latin1_bytes(content, encoding)
    if not isinstance(content, bytes | bytearray):
        raise DataError(f"a bytearray is made of {type(content).__name__}")
    return bytearray(content)


def _reconstruct(kind: Any, shape: Any, dtype: Any) -> Any:
    """Stand-in for NumPy's: an empty array to be filled by its state, as every array's pickle begins."""
    if kind is not np.ndarray or shape != (0,):
        raise DataError("an array is not built the way NumPy writes it")
    return _numpy_core("multiarray", "_reconstruct")(kind, shape, dtype)


def _numpy_core(module: str, name: str) -> Any:
    # NumPy moved its core; old pickles keep the old name.
    core = importlib.import_module("numpy._core" if hasattr(np, "_core") else "numpy.core")
    return getattr(getattr(core, module), name)


_BUILTINS = {"set": set, "frozenset": frozenset, "complex": complex, "bytearray": _bytearray}


def _allowed(module: str, name: str) -> Any:
    if module in ("builtins", "__builtin__"):
        return _BUILTINS.get(name)
    core = module.removeprefix("numpy._core.").removeprefix("numpy.core.")
    if core != module and (core, name) == ("multiarray", "_reconstruct"):
        return _reconstruct
    if core != module and (core, name) in (("multiarray", "scalar"), ("numeric", "_frombuffer")):
        return _numpy_core(core, name)
    if module == "numpy" and name in ("ndarray", "dtype"):
        return getattr(np, name)
    if (module, name) == ("_codecs", "encode"):
        return _latin1_bytes
    return None


class _DataUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        found = _allowed(module, name)
        if found is None:
            raise DataError(f"it asks for {module}.{name}, which is not data")
        return found


def load_pickle(path: str | Path) -> Any:
    """Load a pickle that holds only plain data and NumPy arrays, from Python 2 (as latin-1) or 3.

    Raises:
        DataError: no such file, damaged, or holding anything but data; nothing in it is run.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            return _DataUnpickler(file, encoding="latin-1").load()
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as err:
        raise DataError(f"{path}: {err.strerror or err}") from None
    except DataError as err:
        raise DataError(f"{path}: refused, nothing was run: {err}; get the file from its publisher again") from None
    except (
        pickle.UnpicklingError, EOFError, AttributeError, ImportError, LookupError, TypeError, ValueError,
        MemoryError, OverflowError, RecursionError, struct.error,
    ) as err:  # fmt: skip
        detail = " ".join(str(err).split()) or type(err).__name__
        raise DataError(f"{path}: not a readable pickle ({detail}); get the file from its publisher again") from None
