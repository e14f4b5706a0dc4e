"""Checks at the opening of a shard: its layout against the schema, its extents against the file, its values' ranges.

Nothing of a file is used before. HDF5 can refer to other files (external storage, external links, virtual data sets)
and can announce data that is stored nowhere; shards have neither, so both are refused.
"""

from __future__ import annotations

import errno
import math
import re
import stat
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from labelgen.choices import Pair, parse_size
from labelgen.errors import DataError, LabelgenError
from labelgen.json_file import parse_json
from labelgen.labels import IgnoreReason, Split, VehicleClass
from labelgen.printable import printable
from labelgen.shards.schema import (
    FIELDS,
    FORMAT,
    HASH_ATTRIBUTE,
    READABLE_VERSIONS,
    REQUIRED_ATTRIBUTES,
    TEXT,
    FieldSpec,
    complete_fields,
    fields_of,
)

__all__ = [
    "DAMAGE",
    "ShardLimits",
    "check_attributes",
    "check_fields",
    "check_values",
    "open_shard_file",
    "read_attributes",
    "read_fields",
]

DAMAGE = (LabelgenError, OSError, RuntimeError, LookupError, TypeError, ValueError, MemoryError, OverflowError)
"""What HDF5 and the parsers raise on damaged content."""


@dataclass(frozen=True)
class ShardLimits:
    """What a shard may hold.

    Args:
        base_bytes: bytes of all fields in memory that a file of any size may have.
        bytes_per_byte: further bytes of fields for each byte of the file; compressed fields have more than one.
        text_bytes: bytes that are read at once of a text field, whose rows may all name the same long text.
        coordinate_px: largest coordinate of boxes and windows, px.
        matrix_condition: largest condition number of a homography whose columns are scaled to length 1.
    """

    base_bytes: int = 64_000_000
    bytes_per_byte: int = 8
    text_bytes: int = 64_000_000
    coordinate_px: float = 1e6
    matrix_condition: float = 1e12


_limits = ShardLimits()
_WINDOWED = ("masks",)
# Deflate, shuffle, Fletcher-32, scale-offset, and h5py's LZF.
_FILTERS = frozenset({1, 2, 3, 6, 32000})
_TEXT_ATTRIBUTES = frozenset({"format", "producer", "pair", "size", "source", "settings", HASH_ATTRIBUTE})


def open_shard_file(path: Path) -> h5py.File:
    """Open a shard for reading.

    Raises:
        DataError: no such file, not a regular one, or not HDF5.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataError(f"{path}: not a shard; a {'folder' if path.is_dir() else 'pipe or device'} is in its place")
        return h5py.File(path, "r", locking=False)
    except FileNotFoundError:
        raise DataError(f"{path}: no such shard") from None
    except OSError as err:
        if err.errno == errno.EMFILE:
            raise DataError(f"{path}: too many open files; raise the limit (ulimit -n)") from None
        raise DataError(f"{path}: not a whole HDF5 file ({_reason(err)}); make it again") from None
    except (RuntimeError, ValueError, KeyError) as err:
        raise DataError(f"{path}: not a whole HDF5 file ({_reason(err)}); make it again") from None


def _reason(err: Exception) -> str:
    return printable(" ".join(str(err).split()))[:200] or type(err).__name__


# -- attributes ---------------------------------------------------------------------------------------------


def read_attributes(file: h5py.File) -> dict[str, Any]:
    """Return the attributes of the format that a file has, those of another type as None.

    Raises:
        OSError, RuntimeError, LookupError, TypeError, ValueError: the file is damaged.
    """
    values: dict[str, Any] = {}
    for key in (*REQUIRED_ATTRIBUTES, HASH_ATTRIBUTE):
        if key not in file.attrs:
            continue
        # One value only: an array could name the same text very often.
        single = file.attrs.get_id(key).get_space().get_simple_extent_type() == h5py.h5s.SCALAR
        value = file.attrs[key] if single else None
        value = value.item() if isinstance(value, np.generic) else value
        wanted = str if key in _TEXT_ATTRIBUTES else int
        values[key] = value if type(value) is wanted else None
    return values


def check_attributes(values: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with attributes, the first problem first.

    Args:
        values: of `read_attributes`.
    """
    if values.get("format") != FORMAT:
        return ["not a labelgen shard"]
    if values.get("version") not in READABLE_VERSIONS:
        readable = " and ".join(map(str, READABLE_VERSIONS))
        return [f"shard format {values.get('version')}, this labelgen reads {readable}; use the other one"]
    required = (*REQUIRED_ATTRIBUTES, HASH_ATTRIBUTE)
    missing = [key for key in required if key not in values]
    if missing:
        return [f"damaged, it lacks {', '.join(missing)}; make it again"]
    mistyped = [key for key in required if values[key] is None]
    if mistyped:
        return [f"damaged, its {', '.join(mistyped)} are of another type than the format's; make it again"]
    checks: list[tuple[str, Callable[[], object]]] = [
        ("pair", lambda: Pair.parse(values["pair"])),
        ("size", lambda: parse_size(values["size"])),
        ("settings", lambda: _check_settings(values["settings"])),
        ("part", lambda: _expect(values["part"] >= 0, "is negative")),
        ("last", lambda: _expect(values["last"] in (0, 1), "is neither 0 nor 1")),
        (HASH_ATTRIBUTE, lambda: _expect(re.fullmatch("[0-9a-f]{64}", values[HASH_ATTRIBUTE]), "is no SHA-256")),
        *((key, lambda key=key: _expect("\0" not in values[key], "holds a null")) for key in ("source", "producer")),
    ]
    problems = []
    for key, check in checks:
        try:
            check()
        except (LabelgenError, ValueError) as err:
            problems.append(f"damaged, its {key}: {_reason(err)}; make it again")
    return problems


def _expect(good: object, problem: str) -> None:
    if not good:
        raise ValueError(problem)


def _check_settings(text: str) -> None:
    """Check the settings that are read by name."""
    settings = parse_json(text)
    _expect(isinstance(settings, dict), "not a JSON object")
    for key, top in (("score", 1.0), ("min_height_px", math.inf)):
        value = settings.get(key) or 0
        _expect(_is_number(value) and 0 <= value <= top and math.isfinite(value), f"{key} is out of its range")
    for key in ("kind", "rule", "region"):
        _expect(isinstance(settings.get(key, ""), str), f"{key} is no text")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


# -- fields -------------------------------------------------------------------------------------------------


def check_fields(file: h5py.File, version: int, file_bytes: int) -> list[str]:
    """Return what is wrong with the types, shapes and storage of a shard's fields, before anything of them is read.

    Args:
        file: the shard.
        version: of its format.
        file_bytes: its size.
    """
    problems: list[str] = []
    rows: dict[str, int] = {}
    total = 0
    for name, spec in fields_of(version).items():
        try:
            field_rows, size = _check_field(file, name, spec, file_bytes)
        except _FieldError as err:
            problems.append(f"{name}: {err}")
            continue
        except (OSError, RuntimeError, LookupError, TypeError, ValueError, OverflowError) as err:
            problems.append(f"{name}: cannot be read ({_reason(err)})")
            continue
        total += size
        kind, count = ("N", field_rows - 1) if spec.rows == "N+1" else (spec.rows, field_rows)
        if kind != "*" and rows.setdefault(kind, count) != count:
            expected = rows[kind] + field_rows - count
            problems.append(f"{name}: expected {expected} rows, got {field_rows}")
    if not problems and total > _limits.base_bytes + _limits.bytes_per_byte * file_bytes:
        problems.append(f"its fields announce {total} bytes, far more than a file of {file_bytes} bytes holds")
    return problems


class _FieldError(Exception):
    """What is wrong with one field."""


def _check_field(file: h5py.File, name: str, spec: FieldSpec, file_bytes: int) -> tuple[int, int]:
    """Return the number of rows and of bytes of a field."""
    group, _, key = name.rpartition("/")
    parent = file
    if group:
        _check_link(file, group, h5py.h5o.TYPE_GROUP, group)
        parent = file[group]
    _check_link(parent, key, h5py.h5o.TYPE_DATASET, name)
    dataset = h5py.h5d.open(parent.id, key.encode())
    storage = dataset.get_create_plist()
    if storage.get_external_count() or storage.get_layout() == h5py.h5d.VIRTUAL:
        raise _FieldError("its data lies in another file, which is refused")
    filters = {storage.get_filter(i)[0] for i in range(storage.get_nfilters())}
    if not filters <= _FILTERS:
        raise _FieldError(f"packed by the unknown filter {min(filters - _FILTERS)}")
    if dataset.get_space().get_simple_extent_type() != h5py.h5s.SIMPLE:
        raise _FieldError("expected an array, got a single value or none")
    shape, dtype = dataset.shape, dataset.dtype
    if spec.dtype == TEXT:
        if h5py.check_string_dtype(dtype) is None:
            raise _FieldError(f"expected text, got {dtype}")
    elif dtype != np.dtype(spec.dtype):
        raise _FieldError(f"expected type {spec.dtype}, got {dtype}")
    if len(shape) != 1 + len(spec.shape) or shape[1:] != spec.shape or (spec.rows == "N+1" and shape[0] < 1):
        raise _FieldError(f"expected shape {('*', *spec.shape)}, got {shape}".replace("'", ""))
    size = math.prod(shape) * dataset.get_type().get_size()
    if not filters and dataset.get_storage_size() < size:
        raise _FieldError(f"it announces {size} bytes, of which {dataset.get_storage_size()} are in the file")
    if dataset.get_storage_size() > file_bytes or (not filters and size > file_bytes):
        raise _FieldError(f"it announces {size} bytes in a file of {file_bytes}")
    if storage.get_layout() == h5py.h5d.CHUNKED:
        chunk = math.prod(storage.get_chunk()) * dataset.get_type().get_size()
        if chunk > _limits.base_bytes + file_bytes:
            raise _FieldError(f"it is packed in pieces of {chunk} bytes")
    return shape[0], size


def _check_link(parent: h5py.Group, key: str, kind: int, label: str) -> None:
    """Check that a name in a group is an object of this file; links to other files are not followed."""
    if not parent.id.links.exists(key.encode()):
        raise _FieldError(f"missing; it lacks {label}")
    if parent.id.links.get_info(key.encode()).type != h5py.h5l.TYPE_HARD:
        raise _FieldError("a link to another place, which is refused")
    if h5py.h5o.get_info(parent.id, key.encode()).type != kind:
        raise _FieldError("another kind of HDF5 object")


def read_fields(
    file: h5py.File, version: int, file_bytes: int, *, without: Iterable[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read the fields of a shard whose layout is checked; those that its version lacks get their neutral values.

    Args:
        file: the shard.
        version: of its format.
        file_bytes: size of the file.
        without: names of fields that are not read.

    Raises:
        OSError, RuntimeError, LookupError, TypeError, ValueError: the file is damaged.
    """
    return complete_fields(
        {
            name: _read_text(file[name], file_bytes) if FIELDS[name].dtype == TEXT else file[name][()]
            for name in fields_of(version)
            if name not in without
        }
    )


def _read_text(dataset: h5py.Dataset, file_bytes: int) -> NDArray[Any]:
    """Read a text field in pieces: in a damaged file, each of its rows may name all text of the file."""
    step = max(1, _limits.text_bytes // max(1, file_bytes))
    left = _limits.base_bytes + file_bytes
    rows: list[str] = []
    for start in range(0, len(dataset), step):
        piece = dataset.asstr()[start : start + step].tolist()
        left -= sum(map(len, piece))
        if left < 0:
            raise ValueError(f"{dataset.name}: its texts are longer than the file")
        rows += piece
    if any("\0" in text for text in rows):
        raise ValueError(f"{dataset.name}: a text holds a null")
    array = np.empty(len(rows), dtype=object)
    array[:] = rows
    return array


# -- values -------------------------------------------------------------------------------------------------


def check_values(arrays: Mapping[str, NDArray[Any]], image_bytes: int, settings: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the values of a shard's fields.

    Args:
        arrays: all fields but "images/bytes", of the schema's types and shapes.
        image_bytes: length of "images/bytes".
        settings: of the shard; jobs of some kinds always state windows.
    """
    problems = []
    totals = {
        "images/offset": image_bytes,
        "labels/offset": len(arrays["labels/cc"]),
        "ignored/offset": len(arrays["ignored/reason"]),
    }
    for name, total in totals.items():
        offsets = arrays[name]
        if offsets[0] != 0 or offsets[-1] != total or (offsets[1:] < offsets[:-1]).any():
            problems.append(f"{name}: expected to rise from 0 to {total}")
    with np.errstate(all="ignore"):
        for what, good in _row_checks(arrays).items():
            if not good.all():
                problems.append(f"{what} (first at row {int((~good).argmax())})")
    for name in ("samples/time", "samples/window"):
        missing = np.isnan(arrays[name]).all(axis=tuple(range(1, arrays[name].ndim)))
        needed = name == "samples/window" and settings.get("kind") in _WINDOWED
        if missing.any() and (needed or not missing.all()):
            problems.append(f"{name}: some are missing (first at row {int(missing.argmax())})")
    return problems


def _row_checks(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.bool_]]:
    """Return which rows are right, by what is expected of them."""
    box, cc, camera, score = (arrays[f"{k}"] for k in ("labels/box", "labels/cc", "samples/camera", "labels/score"))
    candidates, window, matrix = arrays["labels/candidates"], arrays["samples/window"], arrays["samples/matrix"]
    time, scale, size = arrays["samples/time"], arrays["cameras/scale"], arrays["cameras/size"]
    sigma, hidden = arrays["labels/sigma"], arrays["labels/hidden"]
    return {
        "labels/box: expected finite x0 < x1, y0 < y1": _is_box(box),
        "labels/cc: expected values in [0, 1]": (cc >= 0) & (cc <= 1),
        "labels/score: expected values in [0, 1]": (score >= 0) & (score <= 1),
        "labels/candidates: expected values in [0, 1] or NaN": (
            np.isnan(candidates) | ((candidates >= 0) & (candidates <= 1))
        ).all(1),
        "labels/sigma: expected finite numbers from 0, or NaN": (
            np.isnan(sigma) | ((sigma >= 0) & (sigma < np.inf))
        ).all(1),
        "labels/hidden: expected values in [0, 1] or NaN": np.isnan(hidden) | ((hidden >= 0) & (hidden <= 1)),
        "ignored/box: expected finite x0 < x1, y0 < y1": _is_box(arrays["ignored/box"]),
        "ignored/reason: unknown reason": np.isin(arrays["ignored/reason"], [int(r) for r in IgnoreReason]),
        "labels/class: unknown class": np.isin(arrays["labels/class"], [int(c) for c in VehicleClass]),
        "samples/split: unknown split": np.isin(arrays["samples/split"], [int(s) for s in Split]),
        "samples/matrix: expected finite, invertible matrices": _is_homography(matrix),
        "samples/vpu: expected finite numbers": np.isfinite(arrays["samples/vpu"]).all(1),
        "samples/window: expected finite x0 < x1, y0 < y1": _is_box(window) | np.isnan(window).all(1),
        "samples/camera: no such camera": (camera >= 0) & (camera < len(scale)),
        "samples/frame: expected numbers from -1": arrays["samples/frame"] >= -1,
        "samples/time: expected finite seconds or NaN": np.isfinite(time) | np.isnan(time),
        "cameras/vp1, vp2, pp: expected finite numbers": np.isfinite(
            np.concatenate([arrays["cameras/vp1"], arrays["cameras/vp2"], arrays["cameras/pp"]], axis=1)
        ).all(1),
        "cameras/scale: expected positive numbers or NaN": np.isnan(scale) | ((scale > 0) & np.isfinite(scale)),
        "cameras/size: expected two positive numbers, or 0": (size > 0).all(1) | (size == 0).all(1),
    }


def _is_box(boxes: NDArray[Any]) -> NDArray[np.bool_]:
    good = np.abs(boxes) <= _limits.coordinate_px
    return np.asarray(good.all(1) & (boxes[:, :2] < boxes[:, 2:]).all(1))


def _is_homography(matrices: NDArray[Any]) -> NDArray[np.bool_]:
    good = np.isfinite(matrices).all((1, 2))
    safe = np.where(good[:, None, None], matrices, np.eye(3))
    # Columns and rows are of very different units: px, px and 1.
    safe = safe / np.maximum(np.linalg.norm(safe, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    safe = safe / np.maximum(np.linalg.norm(safe, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    safe = np.where(np.isfinite(safe), safe, 0)
    lowest = np.linalg.svd(safe, compute_uv=False)
    return np.asarray(good & (lowest[:, 2] * _limits.matrix_condition > lowest[:, 0]))
