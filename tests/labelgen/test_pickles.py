"""The allow-list unpickler: reads data, runs nothing."""

from __future__ import annotations

import os
import pickle
import subprocess
from pathlib import Path

import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.sources.pickles import load_pickle


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
