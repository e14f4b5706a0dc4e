"""The allow-list unpickler: reads data, runs nothing."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy._core import multiarray, numeric

from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import DataError


class _Payload:
    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_plain_data_and_arrays_come_back(tmp_path: Path, protocol: int) -> None:
    data = {
        "text": "uvoz/1/000001_000.png",
        "numbers": [1, 2.5, True, None, 3 + 4j],
        "array": np.arange(6.0).reshape(2, 3),
        "bytes": np.frombuffer(b"\xff\xd8\x00", dtype=np.uint8),
        "scalar": np.float64(2.5),
        "set": {1, 2},
        "raw": b"\x00\xff",
    }
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(data, protocol=protocol))
    back = load_pickle(path)
    assert back.keys() == data.keys()
    for key, value in data.items():
        np.testing.assert_array_equal(back[key], value)


# A Python 2 pickle of {'a': set([1]), 's': '\xe9'}, protocol 2, written by hand from its opcodes.
_PYTHON2 = b"\x80\x02}q\x00(U\x01aq\x01c__builtin__\nset\nq\x02]q\x03K\x01a\x85q\x04Rq\x05U\x01sq\x06U\x01\xe9q\x07u."


def test_python_2_pickle_reads_as_latin_1(tmp_path: Path) -> None:
    path = tmp_path / "old.pkl"
    path.write_bytes(_PYTHON2)
    assert load_pickle(path) == {"a": {1}, "s": "é"}


@pytest.mark.parametrize("function", [os.system, subprocess.call, eval, exec, getattr, __import__])
def test_anything_else_is_refused_and_not_run(tmp_path: Path, function) -> None:
    marker = tmp_path / "ran"
    command = {
        os.system: f"touch {marker}",
        subprocess.call: ["touch", str(marker)],
        getattr: "x",
        __import__: "antigravity",
    }.get(function, f"open({str(marker)!r}, 'w').close()")
    path = tmp_path / "bad.pkl"
    path.write_bytes(pickle.dumps({"cameras": _Payload(function, command)}))
    with pytest.raises(DataError, match=r"bad\.pkl: refused, nothing was run: it asks for .*not data"):
        load_pickle(path)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a readable pickle"),
        (b"PK\x03\x04 not a pickle at all", "not a readable pickle"),
        (pickle.dumps({"a": np.arange(1000)})[:200], "not a readable pickle"),
        (b"\x80\x02cnumpy.core.multiarray\n_reconstruct\nq\x00.", None),
        (pickle.dumps(_Payload(bytes, 10**12)), "refused"),
        (b"c__builtin__\nbytearray\n(L100000000000L\ntR.", "a bytearray is made of int"),
        (
            b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(L100000000000L\ntS'd'\ntR.",
            "not built the way NumPy writes it",
        ),
    ],
    ids=["empty", "other", "cut", "bare-function", "big-bytes", "bytearray-bomb", "array-bomb"],
)
def test_damaged_pickles(tmp_path: Path, content: bytes, message: str | None) -> None:
    path = tmp_path / "x.pkl"
    path.write_bytes(content)
    if message is None:  # harmless: a name alone calls nothing
        load_pickle(path)
    else:
        with pytest.raises(DataError, match=message):
            load_pickle(path)


class _Built:
    """Pickles as the call of a function, then `state` set on what it returns."""

    def __init__(self, function, arguments, state=None):
        self.parts = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self):
        return self.parts


def _dtype(code: str, *, endian="|", subdtype=None, names=None, fields=None, size=-1, align=-1, flags=0) -> _Built:
    return _Built(np.dtype, (code, False, True), (3, endian, subdtype, names, fields, size, align, flags))


def _array(state: object) -> _Built:
    return _Built(multiarray._reconstruct, (np.ndarray, (0,), b"b"), state)


_FLOAT = _dtype("f8", endian="<")
_FAR_FIELD = _dtype("V8", names=("a",), fields={"a": (_dtype("i8"), 10**6)}, size=8, align=1, flags=16)
EVIL = {
    "object-array": _array((1, (4,), _dtype("O8"), False, b"A" * 32)),
    "object-array-flags": _array((1, (4,), _dtype("O8", flags=63), False, b"A" * 32)),
    "object-scalar": _Built(multiarray.scalar, (_dtype("O8"), b"A" * 8)),
    "object-buffer": _Built(numeric._frombuffer, (b"A" * 8, _dtype("O8"), (1,), "C")),
    "far-field": _array((1, (1,), _FAR_FIELD, False, b"A" * 8)),
    "far-field-scalar": _Built(multiarray.scalar, (_FAR_FIELD, b"A" * 8)),
    "sub-array": _array((1, (1,), _dtype("V8", subdtype=(_FLOAT, (10**9,)), size=8), False, b"A" * 8)),
    "item-size": _array((1, (1,), _dtype("S8", size=10**9), False, b"A" * 8)),
    "float-of-another-size": _array((1, (1,), _dtype("f8", size=10**6), False, b"A" * 8)),
    "too-few-bytes": _array((1, (10**9,), _FLOAT, False, b"A" * 8)),
    "size-overflow": _array((1, (2**61, 8), _FLOAT, False, b"")),
    "negative-shape": _array((1, (-1, -1), _FLOAT, False, b"A" * 8)),
    "list-for-numbers": _array((1, (1,), _FLOAT, False, [1.0])),
    "list-of-another-length": _array((1, (4,), _dtype("O8", flags=63), False, [None])),
    "no-code-points": _array((1, (1,), _dtype("U1", endian="<", size=4), False, b"\xff" * 4)),
    "no-truth-values": _array((1, (2,), _dtype("b1"), False, b"\x02\xff")),
    "big-array": _Built(np.ndarray, ((1 << 40,), "u1")),
    "array-of-a-buffer": _Built(np.ndarray, ((1,), "O8", b"A" * 8)),
    "never-filled": _Built(multiarray._reconstruct, (np.ndarray, (0,), b"b")),
    "state-is-no-tuple": _array({"shape": (1,)}),
    "record-dtype": _Built(np.dtype, ([("a", "O")],)),
    "filled-with-a-number": {
        "a": _Built(multiarray.scalar, (_FLOAT, b"A" * 8)),
        "b": _array((1, (1,), _FLOAT, False, 7)),
    },
}


@pytest.mark.parametrize("name", EVIL)
def test_arrays_that_lie_about_their_memory_are_refused(tmp_path: Path, name: str) -> None:
    """In a process of its own: what is not refused may end that process."""
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(EVIL[name], protocol=2))
    code = (
        "import sys\nfrom labelgen.errors import DataError\nfrom labelgen.datasets.safe_pickle import load_pickle\n"
        "try:\n    print(repr(load_pickle('evil.pkl')))\nexcept DataError as err:\n    sys.exit(f'DataError {err}')\n"
    )
    repository = str(Path(__file__).resolve().parents[3])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": repository},
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1, done
    assert done.stderr.startswith("DataError evil.pkl: "), done.stderr
    assert done.stderr.count("\n") == 1


def test_a_pickle_sets_nothing_on_what_it_calls(tmp_path: Path) -> None:
    # BUILD with a pair sets attributes: here the default encoding of the stand-in for _codecs.encode.
    path = tmp_path / "x.pkl"
    path.write_bytes(b"\x80\x02c_codecs\nencode\nN}X\x0c\x00\x00\x00__defaults__X\x04\x00\x00\x00utf8\x85s\x86b.")
    with pytest.raises(DataError, match="refused, nothing was run"):
        load_pickle(path)
    path.write_bytes(pickle.dumps(b"\xff", protocol=2))
    assert load_pickle(path) == b"\xff"


ARRAYS = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
    np.arange(24, dtype=np.uint8).reshape(2, 3, 4).transpose(1, 2, 0),
    np.array([True, False]),
    np.array(["vehicle", "é"]),
    np.array([b"ab", b"c"]),
    np.array([1 + 2j], dtype=np.complex64),
    np.array(3.5),
    np.empty((0, 2)),
    np.array([{"path": "a.png", "box": np.arange(3.0)}, None, "text"], dtype=object),
    np.array([[1, "a"], [None, 2.5]], dtype=object, order="F"),
]


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize("array", ARRAYS, ids=[f"{a.dtype}-{a.shape}" for a in ARRAYS])
def test_arrays_of_every_plain_kind_come_back(tmp_path: Path, array: np.ndarray, protocol: int) -> None:
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps((array, [array], {"a": array}), protocol=protocol))
    first, (second,), named = load_pickle(path)
    assert first is second is named["a"]
    assert type(first) is np.ndarray
    assert first.dtype == array.dtype
    assert first.flags.writeable
    assert repr(first) == repr(array)


def _nested(depth: int) -> object:
    value: object = 1
    for _ in range(depth):
        value = (value,)
    return value


def _program(*parts: bytes) -> bytes:
    return b"\x80\x02" + b"".join(parts) + b"."


_TUPLES_60 = b"K\x01q\x00" + b"".join(b"0h%ch%c\x86q%c" % (i, i, i + 1) for i in range(60))
_LOOP: list[object] = []
_LOOP.append(_LOOP)
_SHARED: list[object] = [1.0]
for _ in range(40):
    _SHARED = [_SHARED, _SHARED]
COSTLY = {
    "huge-memo-number": _program(b"Nr\xff\xff\xff\x0f"),
    "huge-memo-number-as-text": _program(b"Np4000000000\n"),
    "deep-tuple-as-key": _program(b"}K\x01", b"\x85" * 200_000, b"Ns"),
    "deep-tuple-as-key-of-a-dict": _program(b"(K\x01", b"\x85" * 200_000, b"Nd"),
    "deep-tuple-in-a-set": _program(b"\x8f(K\x01", b"\x85" * 200_000, b"\x90"),
    "deep-tuple-in-a-frozenset": _program(b"(K\x01", b"\x85" * 200_000, b"\x91"),
    "deep-tuple-in-a-called-set": _program(b"c__builtin__\nset\n]K\x01", b"\x85" * 200_000, b"a\x85R"),
    "doubled-tuple-as-key": _program(b"}", _TUPLES_60, b"Ns"),
    "doubled-tuple-in-a-set-list-filled-later": _program(
        b"c__builtin__\nset\n]q\xf0\x85q\xf10h\xf0", _TUPLES_60, b"a0c__builtin__\nset\nh\xf1R"
    ),
    "one-array-many-times": _program(
        b"B\x00\x00\x10\x00", bytes(1 << 20), b"q\x000cnumpy\ndtype\nX\x02\x00\x00\x00u1\x85Rq\x010]q\x02(",
        b"cnumpy._core.multiarray\nscalar\ncnumpy\ndtype\nX\x08\x00\x00\x00S1048576\x85Rh\x00\x86R" * 4000, b"e",
    ),
    "one-set-many-times": _program(
        b"](", b"".join(b"J" + i.to_bytes(4, "little") for i in range(20_000)), b"eq\x000](",
        b"c__builtin__\nset\nh\x00\x85R" * 20_000, b"e",
    ),
    "many-empty-dicts": _program(b"](", b"}" * 12_000_000, b"e"),
    "long-numbers-as-keys": _program(
        b"}\x8b\x00\x00\x10\x00", b"\x7f" * (1 << 20), b"q\x00", b"Nsh\x00" * 50_000, b"Ns"
    ),
    "list-that-holds-itself": pickle.dumps(_LOOP, 2),
    "lists-that-share-parts": pickle.dumps({"3DBB": _SHARED}, 2),
    "deep-lists": _program(b"]" * 200_000, b"a" * 199_999),
    "text-longer-than-the-file": _program(b"\x8d\xff\xff\xff\xff\xff\x00\x00\x00"),
    "memory-view": _program(b"C\x01a\x98"),
}  # fmt: skip


@pytest.mark.parametrize("name", COSTLY)
def test_files_that_cost_more_than_their_size_lets_expect_are_refused(tmp_path: Path, name: str) -> None:
    """In a process of its own with 1 GB more than the imports need, and 20 s."""
    (tmp_path / "evil.pkl").write_bytes(COSTLY[name])
    code = (
        "import resource, sys\nfrom labelgen.errors import DataError\n"
        "from labelgen.datasets.safe_pickle import load_pickle\n"
        "pages = int(open('/proc/self/statm').read().split()[0]) if sys.platform == 'linux' else 0\n"
        "if pages:\n    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 10**9,) * 2)\n"
        "try:\n    load_pickle('evil.pkl')\nexcept DataError as err:\n    sys.exit(f'DataError {err}')\n"
    )
    repository = str(Path(__file__).resolve().parents[3])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": repository},
        capture_output=True, text=True, timeout=20,
    )  # fmt: skip
    assert done.returncode == 1, done
    assert done.stderr.startswith("DataError evil.pkl: "), done.stderr
    assert "MemoryError" not in done.stderr
    assert done.stderr.count("\n") == 1


def test_parts_that_are_shared_a_few_times_and_pairs_as_keys_come_back(tmp_path: Path) -> None:
    shared = [np.arange(2), "text"]
    data = {("uvoz", 1): [shared, shared], 2**40: {(1, 2), (3, 4)}, "tuple": _nested(50)}
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(data, protocol=2))
    back = load_pickle(path)
    assert back.keys() == data.keys()
    assert back[("uvoz", 1)][0] is back[("uvoz", 1)][1]
    assert back[2**40] == {(1, 2), (3, 4)}
    assert back["tuple"] == _nested(50)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_a_named_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.pkl")
    with pytest.raises(DataError, match="not a regular file"):
        load_pickle(tmp_path / "pipe.pkl")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.pkl: no such file"):
        load_pickle(tmp_path / "none.pkl")


def test_real_ground_truth_reads(real_data: Path) -> None:
    files = sorted(real_data.glob("brnocompspeed/dataset/*/gt_data.pkl"))
    assert len(files) == 15
    for file in files:
        data = load_pickle(file)
        assert {"fps", "cars", "measurementLines", "laneDivLines", "invalidLanes", "distanceMeasurement"} <= data.keys()
        assert data["fps"] == (25.0 if file.parent.name == "session0_center" else 50.0)
