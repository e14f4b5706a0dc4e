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


def test_values_that_hold_themselves_come_back(tmp_path: Path) -> None:
    loop: list[object] = [np.arange(3)]
    array = np.array([loop, None], dtype=object)
    array[1] = array
    loop += [loop, {"again": (loop, array)}]
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(loop, protocol=2))
    back = load_pickle(path)
    assert back[1] is back
    assert back[2]["again"][0] is back
    assert back[2]["again"][1][1] is back[2]["again"][1]
    assert back[0].tolist() == [0, 1, 2]


def test_tuples_that_share_parts_are_read_once_each(tmp_path: Path) -> None:
    # 2**60 leaves, if every way to them were walked.
    pair: tuple[object, ...] = (np.arange(2), 1)
    for _ in range(60):
        pair = (pair, pair)
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(pair, protocol=2))
    back = load_pickle(path)
    while isinstance(back, tuple):
        back = back[0]
    assert back.tolist() == [0, 1]


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
