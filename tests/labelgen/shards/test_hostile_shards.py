"""Shards and indexes that somebody has tampered with: refused at opening, by every command, in one line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from samples import write_shard

from labelgen.errors import DataError
from labelgen.shards import ShardReader, merge_shards, validate_shard, write_index
from labelgen.shards.schema import HASH_ATTRIBUTE, REQUIRED_ATTRIBUTES, content_hash

Change = Callable[[h5py.File], None]


def _replace(name: str, **how: object) -> Change:
    """Put another data set in a field's place."""

    def change(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **how)

    return change


def _attribute(name: str, value: object) -> Change:
    def change(file: h5py.File) -> None:
        del file.attrs[name]
        file.attrs[name] = value

    return change


def _external(file: h5py.File) -> None:
    size = len(file["rejects"])
    del file["rejects"]
    file.create_dataset("rejects", shape=(size,), dtype="u1", external=[("secret.txt", 0, size)])


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=file["rejects"].shape, dtype="u1")
    layout[:] = h5py.VirtualSource("other.h5", "rejects", shape=file["rejects"].shape)
    del file["rejects"]
    file.create_virtual_dataset("rejects", layout)


def _link(name: str, link: object) -> Change:
    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = link

    return change


def _drop(name: str) -> Change:
    def change(file: h5py.File) -> None:
        del file[name]

    return change


def _group(file: h5py.File) -> None:
    del file["labels/cc"]
    file.create_group("labels/cc")


def _swap(file: h5py.File) -> None:
    file.move("labels/box", "spare")
    file.move("samples/window", "labels/box")
    file.move("spare", "samples/window")


_COMPOUND = np.array([(1, 2.0)] * 3, dtype=[("a", "i4"), ("b", "f8")])
HOSTILE: dict[str, tuple[Change, str]] = {
    "external storage": (_external, "rejects: its data lies in another file, which is refused"),
    "external link": (
        _link("rejects", h5py.ExternalLink("other.h5", "rejects")), "rejects: a link to another place, which is refused"
    ),
    "external link of a group": (
        _link("labels", h5py.ExternalLink("other.h5", "labels")), "labels/box: a link to another place"
    ),
    "soft link": (_link("labels/cc", h5py.SoftLink("/labels/score")), "labels/cc: a link to another place"),
    "virtual data set": (_virtual, "rejects: its data lies in another file, which is refused"),
    "nothing stored": (
        _replace("images/bytes", shape=(4_000_000_000,), dtype="u1", fillvalue=7), "images/bytes: it announces 40000"
    ),
    "nothing stored in pieces": (
        _replace("images/bytes", shape=(4_000_000_000,), dtype="u1", chunks=(1000,)), "images/bytes: it announces"
    ),
    "packed bomb": (
        _replace("rejects", data=np.zeros(100_000_000, np.uint8), chunks=(1_000_000,), compression=9),
        "far more than a file of",
    ),
    "too many rows": (_replace("samples/frame", data=np.arange(4)), "samples/frame: expected 3 rows, got 4"),
    "group for a field": (_group, "labels/cc: another kind of HDF5 object"),
    "compound": (_replace("samples/frame", data=_COMPOUND), "samples/frame: expected type <i8"),
    "text for numbers": (_replace("labels/cc", data=["a"] * 6), "labels/cc: expected type <f4"),
    "numbers for text": (_replace("samples/source", data=np.arange(3)), "samples/source: expected text"),
    "references": (_replace("labels/cc", shape=(6,), dtype=h5py.ref_dtype), "labels/cc: expected type"),
    "ragged": (_replace("labels/cc", shape=(6,), dtype=h5py.vlen_dtype("f4")), "labels/cc: expected type"),
    "empty": (_replace("labels/cc", data=h5py.Empty("f4")), "labels/cc: expected an array, got a single value or none"),
    "one value": (_replace("labels/cc", data=np.float32(0.5)), "labels/cc: expected an array, got a single value"),
    "flat boxes": (_replace("labels/box", data=np.zeros(24, np.float32)), "labels/box: expected shape (*, 4)"),
    "swapped tables": (_swap, "labels/box: expected type <f4"),
    "no offsets": (_replace("labels/offset", shape=(0,), dtype="i8"), "labels/offset: expected shape"),
    "no ignored boxes": (_drop("ignored/box"), "ignored/box: missing"),
    "ignored reasons of another length": (
        _replace("ignored/reason", data=np.zeros(50, np.uint8)), "ignored/reason: expected"
    ),
    "hidden for other labels": (_replace("labels/hidden", data=np.zeros(50, np.float32)), "labels/hidden: expected 6"),
    "said to be of version 0": (_attribute("version", 0), "shard format 0, this labelgen reads 1 and 2"),
    "no UTF-8": (_replace("samples/source", data=np.array([b"\xff"] * 3)), "codec can't decode"),
    "version is an array": (_attribute("version", [1, 1]), "shard format None"),
    "version is text": (_attribute("version", "1"), "shard format None"),
    "pair is a number": (_attribute("pair", 7), "its pair are of another type"),
    "source is bytes": (_attribute("source", np.bytes_(b"clip")), "its source are of another type"),
    "size of millions": (_attribute("size", "9999999x9999999"), "its size: size 9999999x9999999: unknown size"),
    "settings no JSON": (_attribute("settings", "{"), "its settings: "),
    "settings a list": (_attribute("settings", "[]"), "its settings: not a JSON object"),
    "settings deep": (_attribute("settings", "[" * 60_000), "its settings: nested too deep"),
    "score out of range": (_attribute("settings", '{"score": 2}'), "its settings: score is out of its range"),
    "height infinite": (_attribute("settings", '{"min_height_px": Infinity}'), "its settings: min_height_px is out"),
    "hash is no hash": (_attribute("content_sha256", "abc"), "its content_sha256: is no SHA-256"),
    "last is 7": (_attribute("last", 7), "its last: is neither 0 nor 1"),
}  # fmt: skip


def _tampered(path: Path, change: Change, *, rehash: bool = False) -> None:
    write_shard(path)
    with h5py.File(path, "r+") as file:
        change(file)
        if rehash:
            attributes = {key: file.attrs[key] for key in REQUIRED_ATTRIBUTES}
            text = h5py.check_string_dtype
            arrays: dict[str, np.ndarray] = {}
            file.visititems(
                lambda name, item: (
                    arrays.update({name: item.asstr()[()] if text(item.dtype) else item[()]})
                    if isinstance(item, h5py.Dataset)
                    else None
                )
            )
            file.attrs[HASH_ATTRIBUTE] = content_hash(attributes, arrays)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_tampered_layout_is_refused_by_reader_validation_and_merging(tmp_path: Path, name: str) -> None:
    change, message = HOSTILE[name]
    (tmp_path / "secret.txt").write_bytes(b"secret" * 100)
    write_shard(tmp_path / "other.h5")
    path = tmp_path / "shard-00000.h5"
    _tampered(path, change)
    problems = validate_shard(path)
    assert any(message in problem for problem in problems), problems
    with pytest.raises(DataError) as caught, ShardReader(path) as reader:
        reader.table("labels/cc"), reader.rejects, reader[0].image
    assert "\n" not in str(caught.value)
    if message and not message.startswith("codec"):
        assert message in str(caught.value)
    with pytest.raises(DataError, match=r"shard-00000\.h5: "):
        merge_shards([path], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def _set(name: str, index: object, value: object) -> Change:
    def change(file: h5py.File) -> None:
        file[name][index] = value

    return change


def _rejects(*lines: object) -> Change:
    data = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
    return _replace("rejects", data=np.frombuffer(data, np.uint8))


_REJECT = {"source": "a", "frame": 1, "item": 0, "reason": "cut", "detail": ""}
WRONG_VALUES: dict[str, tuple[Change, str]] = {
    "singular matrix": (_set("samples/matrix", 0, np.ones((3, 3))), "samples/matrix: expected finite, invertible"),
    "zero matrix": (_set("samples/matrix", 1, 0), "samples/matrix: expected finite, invertible matrices (first at"),
    "NaN matrix": (_set("samples/matrix", (0, 0, 0), np.nan), "samples/matrix: expected finite"),
    "NaN window": (_set("samples/window", 0, np.nan), "samples/window: some are missing (first at row 0)"),
    "half a NaN window": (_set("samples/window", (0, 1), np.nan), "samples/window: expected finite x0 < x1"),
    "huge window": (_set("samples/window", 0, (0, 0, 1e9, 1e9)), "samples/window: expected finite x0 < x1"),
    "one NaN time": (_set("samples/time", 0, np.nan), "samples/time: some are missing (first at row 0)"),
    "infinite time": (_set("samples/time", 0, np.inf), "samples/time: expected finite seconds or NaN"),
    "unknown split": (_set("samples/split", 0, 99), "samples/split: unknown split"),
    "camera out of range": (_set("samples/camera", 0, 2**31 - 1), "samples/camera: no such camera"),
    "negative frame": (_set("samples/frame", 0, -5), "samples/frame: expected numbers from -1"),
    "score above 1": (_set("labels/score", 0, 1.5), "labels/score: expected values in [0, 1]"),
    "candidate above 1": (_set("labels/candidates", 0, 2), "labels/candidates: expected values in [0, 1] or NaN"),
    "negative sigma": (_set("labels/sigma", (0, 4), -1), "labels/sigma: expected finite numbers from 0, or NaN"),
    "infinite sigma": (_set("labels/sigma", (0, 0), np.inf), "labels/sigma: expected finite numbers from 0, or NaN"),
    "more than all hidden": (_set("labels/hidden", 0, 1.5), "labels/hidden: expected values in [0, 1] or NaN"),
    "ignored box without area": (_set("ignored/box", 0, (5, 5, 5, 9)), "ignored/box: expected finite x0 < x1"),
    "ignored box that is NaN": (_set("ignored/box", (0, 1), np.nan), "ignored/box: expected finite x0 < x1"),
    "unknown reason": (_set("ignored/reason", 0, 77), "ignored/reason: unknown reason"),
    "ignored offsets too far": (_set("ignored/offset", -1, 99), "ignored/offset: expected to rise from 0 to"),
    "box of 1e30": (_set("labels/box", 0, (0, 0, 1e30, 1e30)), "labels/box: expected finite x0 < x1"),
    "NaN vanishing point": (_set("cameras/vp1", 0, np.nan), "cameras/vp1, vp2, pp: expected finite numbers"),
    "impossible camera": (_set("cameras/vp2", 0, (269.2, -43.6)), "cannot be orthogonal"),
    "negative scale": (_set("cameras/scale", 0, -1), "cameras/scale: expected positive numbers or NaN"),
    "half a size": (_set("cameras/size", (0, 0), 0), "cameras/size: expected two positive numbers, or 0"),
    "offsets fall": (_set("labels/offset", 1, 4), "labels/offset: expected to rise"),
    "rejects that are lists": (_rejects([]), "rejects: line 1 is not a reject"),
    "rejects of other types": (_rejects(_REJECT, {**_REJECT, "frame": "1"}), "rejects: line 2 is not a reject"),
    "rejects with more": (_rejects({**_REJECT, "more": 1}), "rejects: line 1 is not a reject"),
    "rejects no JSON": (_replace("rejects", data=np.frombuffer(b"{\n", np.uint8)), "Expecting"),
    "rejects no UTF-8": (_replace("rejects", data=np.frombuffer(b'"\xff"\n', np.uint8)), "codec can't decode"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_VALUES)
def test_wrong_values_with_a_right_hash_are_refused(tmp_path: Path, name: str) -> None:
    change, message = WRONG_VALUES[name]
    path = tmp_path / "shard-00000.h5"
    _tampered(path, change, rehash=True)
    problems = validate_shard(path)
    if name == "offsets fall":
        assert problems
    else:
        assert any(message in problem for problem in problems), problems
    with pytest.raises(DataError) as caught, ShardReader(path) as reader:
        len(reader), reader.rejects, reader.cameras, [sample.labels for sample in reader]
    assert str(caught.value).startswith(f"{path}: damaged")
    with pytest.raises(DataError):
        merge_shards([path], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_a_flipped_byte_is_not_merged(tmp_path: Path) -> None:
    path = tmp_path / "a" / "shard-00000.h5"
    path.parent.mkdir()
    write_shard(path)
    write_index(path.parent, [path], {"command": "test"})
    data = bytearray(path.read_bytes())
    data[data.find(b"\x89PNG") + 60] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"hash differs\); nothing was merged, labelgen validate lists all"):
        merge_shards([path.parent], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_pipes_are_not_waited_for(tmp_path: Path, labelgen_process) -> None:
    os.mkfifo(tmp_path / "pipe.h5")
    for command in ("inspect", "validate"):
        done = labelgen_process(command, "pipe.h5", timeout=60)
        assert done.returncode == 2
        assert "pipe.h5: not a shard; a pipe or device is in its place" in done.stderr
    folder = tmp_path / "set"
    folder.mkdir()
    write_shard(folder / "shard-00000.h5")
    os.mkfifo(tmp_path / "video.mp4")
    write_index(folder, [folder / "shard-00000.h5"], {}, {"clip": {"path": str(tmp_path / "video.mp4")}})
    done = labelgen_process("audit", "set", "--out", "page", timeout=60)
    assert done.returncode == 0, done.stderr


INDEXES = {
    "a name that leads out": ({"shards": [{"name": ".."}]}, "its name is not that of a file beside the index"),
    "a name with a null": ({"shards": [{"name": "a\0.h5"}]}, "its name is not that of a file"),
    "counts of text": ({"images": "3"}, "its number of images is no count"),
    "a negative count": ({"labels": -1}, "its number of labels is no count"),
    "an original that is a list": ({"shards": [{"name": "a.h5", "original": []}]}, "its original is not an object"),
    "a path that is a number": ({"shards": [{"name": "a.h5", "original": {"path": 1}}]}, "its original is no"),
    "a job that is text": ({"job": "x"}, "its job is of another type"),
    "reasons that are a list": ({"rejects_by_reason": []}, "its rejects_by_reason is of another type"),
    "another format": ({"format": "x"}, "its format is x"),
    "a shard twice": ({"shards": [{"name": "a.h5"}] * 2}, "a shard is named twice"),
}  # fmt: skip


@pytest.mark.parametrize("name", INDEXES)
@pytest.mark.parametrize("command", ["inspect", "validate", "merge", "audit"])
def test_a_tampered_index_is_one_line(labelgen, tmp_path: Path, name: str, command: str) -> None:
    changes, message = INDEXES[name]
    folder = tmp_path / "set"
    folder.mkdir()
    write_shard(folder / "shard-00000.h5")
    write_index(folder, [folder / "shard-00000.h5"], {"command": "test"})
    index = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps({**index, **changes}))
    done = labelgen(command, "set", *(["--out", "out"] if command in ("merge", "audit") else []))
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out" / "dataset.json").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_text_fields_that_name_one_text_very_often_do_not_fill_the_memory(tmp_path: Path) -> None:
    """100 000 rows of one text of 1 MB: 100 GB, if they were read."""
    path = tmp_path / "shard-00000.h5"
    rows = 100_000
    write_shard(path, samples=0)
    with h5py.File(path, "r+") as file:
        for name in ("images/offset", "labels/offset", "ignored/offset"):
            _replace(name, data=np.zeros(rows + 1, "i8"))(file)
        for name in ("matrix", "vpu", "window", "camera", "frame", "time", "split"):
            field = file[f"samples/{name}"]
            _replace(f"samples/{name}", data=np.zeros((rows, *field.shape[1:]), field.dtype))(file)
        del file["samples/source"]
        field = file.create_dataset("samples/source", shape=(rows,), dtype=h5py.string_dtype())
        field[0] = "x" * 1_000_000
        start = field.id.get_offset()
    data = bytearray(path.read_bytes())
    data[start : start + 16 * rows] = data[start : start + 16] * rows
    path.write_bytes(data)
    code = (
        "import resource\nfrom labelgen.errors import DataError\nfrom labelgen.shards import ShardReader\n"
        "pages = int(open('/proc/self/statm').read().split()[0])\n"
        "resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 10**9,) * 2)\n"
        "try:\n    len(ShardReader('shard-00000.h5'))\n"
        "except DataError as err:\n    raise SystemExit(f'DataError {err}')\n"
    )
    repository = str(Path(__file__).resolve().parents[3])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": repository},
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert "its texts are longer than the file" in done.stderr, done.stderr
