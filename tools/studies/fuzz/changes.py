"""Seeded changes of values, bytes, JSON, pickles, pictures and HDF5 files."""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

from tools.studies.fuzz.good_files import Rng

__all__ = [
    "change_bytes",
    "change_hdf5",
    "change_json",
    "change_pickle",
    "change_pickle_in_zip",
    "change_value",
    "changed_picture",
    "strange_value",
]

_LONG, _DEEP, _WIDE = "x" * 100_000, 5_000, 200_000


def strange_value(rng: Rng) -> Any:
    """Return a value that is seldom what is expected."""
    deep: Any = 1
    for _ in range(60):
        deep = [deep]
    values: list[Any] = [
        None, True, False, 0, -1, 1, 2**31, 2**63, -(2**63), 10**400, 0.5, -0.5, 1e308, -1e308, 1e-320, float("nan"),
        float("inf"), float("-inf"), "", "x", "1", "NaN", "\0", "../../etc/passwd", "/dev/zero", "=1+1", "\x1b[2J", "é",
        "\ud800", _LONG, [], [[]], [None], [1, 2], [1.0] * 5000, ["a", "b"], {}, {"a": 1}, {"": None}, deep,
    ]  # fmt: skip
    return values[rng.integers(len(values))]


def _places(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to every value inside another one."""
    if way:
        yield way
    parts: Any = ()
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list | tuple):
        parts = list(enumerate(value))[:20]
    for key, part in parts:
        yield from _places(part, (*way, key))


def change_value(rng: Rng, data: Any, strange: Callable[[Rng], Any] = strange_value) -> str:
    """Change a value inside another one, in place."""
    ways = [way for way in _places(data) if not isinstance(_at(data, way[:-1]), tuple)]
    *way, key = ways[rng.integers(len(ways))]
    holder = _at(data, way)
    kind = rng.integers(5)
    if kind == 0:
        if isinstance(holder, dict):
            del holder[key]
        else:
            holder.pop(key)
        return f"{[*way, key]} removed"
    if kind == 1 and isinstance(holder[key], list) and holder[key]:
        holder[key] = holder[key] * int(rng.integers(2, 50))
        return f"{[*way, key]} repeated"
    if kind == 2 and isinstance(holder[key], int | float) and abs(holder[key]) < 1e300:
        holder[key] = holder[key] * float(10.0 ** rng.integers(-12, 40))
        return f"{[*way, key]} = {holder[key]}"
    holder[key] = strange(rng)
    return f"{[*way, key]} = {repr(holder[key])[:60]}"


def _at(data: Any, way: Sequence[Any]) -> Any:
    for key in way:
        data = data[key]
    return data


def change_bytes(rng: Rng, data: bytes) -> tuple[bytes, str]:
    """Flip, cut, insert, repeat or overwrite bytes."""
    content = bytearray(data)
    kind = int(rng.integers(6))
    at = int(rng.integers(len(content)))
    if kind == 0:
        for _ in range(int(rng.integers(1, 20))):
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del content[at:]
    elif kind == 2:
        content[at:at] = rng.bytes(int(rng.integers(1, 200)))
    elif kind == 3:
        content[at : at + int(rng.integers(1, 64))] = b"\xff" * int(rng.integers(1, 64))
    elif kind == 4:
        del content[at : at + int(rng.integers(1, 200))]
    else:
        content += content[at:]
    return bytes(content), ("flip", "cut", "insert", "overwrite", "remove", "repeat")[kind]


def change_json(rng: Rng, text: str) -> tuple[bytes, str]:
    """Change JSON text: a value, its bytes, or all of it."""
    kind = int(rng.integers(10))
    if kind == 0:
        return change_bytes(rng, text.encode())
    if kind == 1:
        whole: list[tuple[bytes, str]] = [
            (b"", "empty"), (b"[" * 100_000, "deep"), (b'{"a":' * 100_000, "deep objects"), (b"\xff" * 9, "no text"),
            (b"[" + b"{}," * _WIDE + b"{}]", "very many empty objects"), (b"9" * 100_000, "long"),
            (b'"' + b"x" * 1_000_000 + b'"', "a long text"), (b"null", "null"), (text.encode("utf-16"), "UTF-16"),
        ]  # fmt: skip
        return whole[rng.integers(len(whole))]
    data = json.loads(text)
    changes = [change_value(rng, data) for _ in range(int(rng.integers(1, 4)))]
    return json.dumps(data).encode("utf-8", "surrogatepass"), "; ".join(changes)


def change_pickle_in_zip(rng: Rng, source: Path, target: Path) -> tuple[bytes, str]:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        change = ""
        for info in old.infolist():
            content = old.read(info)
            if info.filename.endswith("data.pkl"):
                content, change = change_pickle(rng, content)
            new.writestr(info, content)
    return b"", change


def change_pickle(rng: Rng, content: bytes) -> tuple[bytes, str]:
    """Change a pickle: its bytes, or to a program that costs much."""
    programs: list[tuple[bytes, str]] = [
        (b"\x80\x02Nr\xff\xff\xff\x7f.", "huge memo"),
        (b"\x80\x02}K\x01" + b"\x85" * 300_000 + b"Ns.", "deep key"),
        (
            b"\x80\x02}K\x01q\x00" + b"".join(b"0h%ch%c\x86q%c" % (i, i, i + 1) for i in range(60)) + b"Ns.",
            "doubled key",
        ),
        (b"\x80\x02](" + b"}" * 3_000_000 + b"e.", "many objects"),
        (b"\x80\x02" + b"]" * 300_000 + b"a" * 299_999 + b".", "deep lists"),
        (b"cos\nsystem\n(S'true'\ntR.", "a call"),
        (b"\x80\x02]q\x00h\x00a.", "a list in itself"),
        (b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.", "huge frame"),
        (b"", "empty"),
    ]
    if rng.random() < 0.4:
        return programs[rng.integers(len(programs))]
    return change_bytes(rng, content)


def changed_picture(rng: Rng, path: Path) -> tuple[bytes, str]:
    kind = int(rng.integers(6))
    if kind == 0:
        width, height = (int(n) for n in rng.choice([1, 20_000, 60_000, 2**31 - 1], 2))
        content = bytearray(path.read_bytes())
        content[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
        return bytes(content), f"announces {width}x{height}"
    if kind == 1:
        return b"P5\n40000 40000\n255\n" + bytes(1000), "a large PGM"
    if kind == 2:
        encoded = cv2.imencode(".jpg", np.zeros((10, 10, 3), np.uint8))[1].tobytes()
        return change_bytes(rng, encoded)
    if kind == 3:
        shape = [(1, 1), (1, 5000), (3000, 3000), (181, 320)][rng.integers(4)]
        return cv2.imencode(".png", np.full(shape, 255, np.uint8))[1].tobytes(), f"of {shape}"
    return change_bytes(rng, path.read_bytes())


def change_hdf5(rng: Rng, file: h5py.File, work: Path) -> str:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    name, kind = names[rng.integers(len(names))], int(rng.integers(14))
    dataset = file[name]
    shape, dtype, text = dataset.shape, dataset.dtype, h5py.check_string_dtype(dataset.dtype) is not None
    if kind < 4:
        key = list(file.attrs)[rng.integers(len(file.attrs))]
        if kind == 0:
            del file.attrs[key]
            return f"attribute {key} removed"
        value = strange_value(rng)
        with contextlib.suppress(Exception):
            del file.attrs[key]
            file.attrs[key] = json.dumps(value) if kind == 1 else value
        return f"attribute {key} = {repr(value)[:60]}"
    if kind < 8 and dataset.size and not text:
        index = tuple(int(rng.integers(n)) for n in shape)
        values = [0, 1, 255, -1, 2**31 - 1, 2**63 - 1, 1e30, -1e30, np.nan, np.inf, 0.5]
        value = values[rng.integers(len(values))]
        with contextlib.suppress(OverflowError, ValueError, TypeError):
            dataset[index] = value
        return f"{name}{index} = {value}"
    del file[name]
    (work / "secret.txt").write_bytes(b"secret" * 1000)
    size = max(1, int(np.prod(shape)))
    with contextlib.suppress(Exception):
        if kind == 8:
            file.create_dataset(name, shape=(4_000_000_000, *shape[1:]), dtype=dtype, fillvalue=None if text else 1)
        elif kind == 9:
            file.create_dataset(name, shape=shape, dtype="u1", external=[(str(work / "secret.txt"), 0, size)])
        elif kind == 10:
            file[name] = h5py.ExternalLink("/etc/hostname", "x") if rng.random() < 0.5 else h5py.SoftLink("/images")
        elif kind == 11:
            file.create_dataset(name, data=[h5py.Empty("f4"), np.float32(1), "text", ["a"] * 3][rng.integers(4)])
        elif kind == 12:
            other = ("f8", "i2", "S3", "c16", "?")[rng.integers(5)]
            file.create_dataset(name, data=np.zeros(shape, other))
        elif kind == 13:
            os.mkfifo(work / "pipe")
            layout = h5py.VirtualLayout(shape=(size,), dtype="u1")
            layout[:] = h5py.VirtualSource(str(work / "pipe"), "x", shape=(size,))
            file.create_virtual_dataset(name, layout)
    return f"{name} replaced, kind {kind}"
