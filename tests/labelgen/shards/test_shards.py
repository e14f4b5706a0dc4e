"""Shards: what is written comes back, in any process, and damage is found."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import pickle
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from samples import CAMERA, SIZE, make_sample, write_shard

from labelgen.errors import DataError, OutputError
from labelgen.geometry import Camera, Pair
from labelgen.labels import IgnoredBoxes, Labels
from labelgen.shards import (
    Reject,
    ShardDataset,
    ShardReader,
    ShardWriter,
    merge_shards,
    summarise,
    validate_shard,
    validate_shards,
    write_index,
)


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "shard-00000.h5"
    other = Camera(CAMERA.vp1 + 5, CAMERA.vp2, CAMERA.pp, name="no scale, no size")
    fitted = Labels([[3, 4, 20, 30]], [0.5], sigmas=[[0.5, 1, 0.25, np.nan, 0.125]], hidden=[0.5])
    written = [
        make_sample(0),
        make_sample(1, 3, camera=other, source="straße/1.png"),
        replace(make_sample(2), labels=fitted, ignored=IgnoredBoxes([[1, 2, 3, 4], [-5, 6, 7, 8]], [5, 1])),
    ]
    with ShardWriter(path, Pair.VP2_VP3, SIZE, source="clip", settings={"rule": "wider"}) as writer:
        for sample in written:
            writer.add(sample)
        writer.reject(Reject("clip", 7, 2, "too small", "4.0 px"))
    with ShardReader(path) as reader:
        assert len(reader) == 3
        assert reader.label_count == 6
        assert reader.pair is Pair.VP2_VP3
        assert reader.size_wh == SIZE
        assert reader.settings == {"rule": "wider"}
        assert reader.rejects == [Reject("clip", 7, 2, "too small", "4.0 px")]
        assert reader.cameras == [CAMERA, other]
        for before, after in zip(written, reader, strict=True):
            assert after.encoded == before.encoded
            assert (after.source, after.frame, after.time_s, after.split) == (
                before.source,
                before.frame,
                before.time_s,
                before.split,
            )
            np.testing.assert_array_equal(after.rectification.matrix, before.rectification.matrix)
            np.testing.assert_array_equal(after.rectification.vpu, before.rectification.vpu)
            np.testing.assert_allclose(after.labels.boxes_xyxy, before.labels.boxes_xyxy, rtol=1e-6)
            np.testing.assert_allclose(after.labels.cc, before.labels.cc, rtol=1e-6)
            np.testing.assert_array_equal(after.labels.flags, before.labels.flags)
            np.testing.assert_array_equal(after.labels.class_ids, before.labels.class_ids)
            assert np.isnan(after.labels.candidates).all()
            np.testing.assert_array_equal(after.labels.sigmas, before.labels.sigmas)
            np.testing.assert_array_equal(after.labels.hidden, before.labels.hidden)
            np.testing.assert_allclose(after.ignored.boxes_xyxy, before.ignored.boxes_xyxy, rtol=1e-6)
            np.testing.assert_array_equal(after.ignored.reasons, before.ignored.reasons)
            points, valid = after.vertices_px()
            wanted, _ = before.vertices_px()
            assert valid.all()
            np.testing.assert_allclose(points, wanted, atol=1e-2)
    assert validate_shard(path) == []


def test_same_samples_same_bytes(tmp_path: Path) -> None:
    digests = set()
    for name in ("a.h5", "b.h5"):
        write_shard(tmp_path / name)
        digests.add(hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    assert len(digests) == 1
    assert write_shard(tmp_path / "c.h5", seed=9).content_sha256 != write_shard(tmp_path / "d.h5").content_sha256


def test_nothing_appears_when_the_writer_fails(tmp_path: Path) -> None:
    with (
        pytest.raises(ZeroDivisionError),
        ShardWriter(tmp_path / "shard-00000.h5", Pair.VP2_VP3, SIZE) as writer,
    ):
        writer.add(make_sample(1 // len(writer)))
    assert list(tmp_path.iterdir()) == []


def test_samples_of_another_kind_are_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="expected a sample of VP1-VP2 36x64, got VP2-VP3 64x36"),
        ShardWriter(tmp_path / "shard-00000.h5", Pair.VP1_VP2, (36, 64)) as writer,
    ):
        writer.add(make_sample(0))


def test_unwritable_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"cannot write .*missing"):
        write_shard(tmp_path / "missing" / "shard-00000.h5")


def test_empty_shard(tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-00000.h5", samples=0)
    with ShardReader(tmp_path / "shard-00000.h5") as reader:
        assert (len(reader), reader.label_count, len(reader.rejects)) == (0, 0, 1)
    assert validate_shard(tmp_path / "shard-00000.h5") == []


def _sum_of(reader: ShardReader, queue) -> None:
    queue.put((len(reader), sum(len(sample.encoded) + len(sample.labels) for sample in reader)))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_an_open_reader_goes_to_other_processes(tmp_path: Path, method: str) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path)
    reader = ShardReader(path)
    wanted = (len(reader), sum(len(sample.encoded) + len(sample.labels) for sample in reader))
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    workers = [context.Process(target=_sum_of, args=(reader, queue)) for _ in range(2)]
    for worker in workers:
        worker.start()
    results = [queue.get(timeout=60) for _ in workers]
    for worker in workers:
        worker.join()
    assert results == [wanted, wanted]
    assert len(reader[0].encoded) > 0  # still usable here


def test_a_pickled_reader_does_not_carry_the_tables(tmp_path: Path) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path, samples=50)
    reader = ShardReader(path)
    assert len(reader) == 50
    data = pickle.dumps(reader)
    assert len(data) < 1000
    assert len(pickle.loads(data)) == 50


def _edit(path: Path, change) -> None:
    with h5py.File(path, "r+") as file:
        change(file)


def _set(name: str, index, value):
    def change(file: h5py.File) -> None:
        file[name][index] = value

    return change


def _drop(name: str):
    def change(file: h5py.File) -> None:
        del file[name]

    return change


def _retype(file: h5py.File) -> None:
    values = file["labels/cc"][()]
    del file["labels/cc"]
    file["labels/cc"] = values.astype("<f8")


def _attribute(name: str, value):
    def change(file: h5py.File) -> None:
        file.attrs[name] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("labels/cc", 0, 1.5), "labels/cc: expected values in"),
        (_set("labels/cc", 0, np.nan), "labels/cc: expected values in"),
        (_set("labels/cc", 0, 0.5), "hash differs"),
        (_set("labels/box", 0, (5, 5, 4, 4)), "labels/box: expected finite"),
        (_set("labels/class", 0, 200), "labels/class: unknown class"),
        (_set("labels/offset", 1, 99), "labels/offset: expected to rise"),
        (_set("images/offset", -1, 1), "images/offset: expected to rise"),
        (_set("images/bytes", slice(None), 0), "images: number 0 is not an image"),
        (_set("samples/vpu", 0, np.inf), "samples/vpu: expected finite"),
        (_set("samples/camera", 0, 7), "samples/camera: no such camera"),
        (_set("rejects", 0, 0), "hash differs"),
        (_drop("labels/flags"), "lacks labels/flags"),
        (_retype, "labels/cc: expected type <f4"),
        (_attribute("version", 99), "shard format 99, this labelgen reads 1 and 2"),
        (_attribute("format", "other"), "not a labelgen shard"),
        (_attribute("pair", "VP9-VP9"), "unknown pair"),
    ],
)
def test_validate_finds_damage(tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path)
    assert validate_shard(path) == []
    _edit(path, change)
    problems = validate_shard(path)
    assert any(message in problem for problem in problems), problems


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.99])
def test_a_cut_file_is_no_shard(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else int(keep)])
    with pytest.raises(DataError, match="not a whole HDF5 file"):
        len(ShardReader(path))
    assert validate_shard(path)


def test_validate_compares_folder_and_index(tmp_path: Path) -> None:
    shards = [tmp_path / f"shard-{i:05d}.h5" for i in range(2)]
    for i, path in enumerate(shards):
        write_shard(path, seed=i)
    write_index(tmp_path, shards, {"command": "test"})
    assert not any(validate_shards([tmp_path]).values())
    write_shard(shards[1], seed=5)
    write_shard(tmp_path / "shard-00002.h5")
    shards[0].unlink()
    problems = validate_shards([tmp_path])[tmp_path]
    assert problems == [
        "shard-00000.h5: named in dataset.json but missing",
        "shard-00002.h5: not named in dataset.json",
        "shard-00001.h5: not the file named in dataset.json (its hash differs)",
    ]


def _data_set(folder: Path) -> list[Path]:
    shards = [folder / f"shard-{i:05d}.h5" for i in range(2)]
    for i, path in enumerate(shards):
        write_shard(path, seed=i, rejects=i + 1)
    write_index(folder, shards, {"command": "test"})
    return shards


def test_index_counts_and_rejects(tmp_path: Path) -> None:
    summary = summarise([ShardReader(path) for path in _data_set(tmp_path)])
    index = json.loads((tmp_path / "dataset.json").read_text())
    assert (summary.images, summary.labels, summary.rejects, summary.shards) == (6, 12, 3, 2)
    assert (index["images"], index["labels"], index["rejects"]) == (6, 12, 3)
    lines = (tmp_path / "rejects.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["reason"] for line in lines] == ["too small"] * 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda index: index.update(content_sha256="0"), "content_sha256 is '0', in its shards"),
        (lambda index: index.update(pair="VP1-VP2"), "pair is 'VP1-VP2', in its shards 'VP2-VP3'"),
        (lambda index: index.update(version=99), "version is 99"),
        (lambda index: index.update(labels=13), "labels is 13, in its shards 12"),
        (lambda index: index.update(rejects_by_reason={}), "rejects_by_reason is {}"),
        (lambda index: index["shards"][0].update(labels=7), "its entry of shard-00000.h5 differs from the shard"),
        (lambda index: index["shards"].reverse(), "content_sha256 is"),
        (lambda index: index["shards"][0].update(name="../x.h5"), "not an index of shards"),
        (lambda index: index.update(shards=["a"]), "not an index of shards"),
    ],
)
def test_validate_finds_a_tampered_index(tmp_path: Path, change, message: str) -> None:
    _data_set(tmp_path)
    index = json.loads((tmp_path / "dataset.json").read_text())
    change(index)
    (tmp_path / "dataset.json").write_text(json.dumps(index))
    try:
        problems = [text for found in validate_shards([tmp_path]).values() for text in found]
    except DataError as err:
        problems = [str(err)]
    assert any(message in problem for problem in problems), problems


@pytest.mark.parametrize("content", [None, b"hello"])
def test_validate_finds_other_rejects(tmp_path: Path, content: bytes | None) -> None:
    _data_set(tmp_path)
    if content is None:
        (tmp_path / "rejects.jsonl").unlink()
    else:
        (tmp_path / "rejects.jsonl").write_bytes(content)
    assert any("rejects.jsonl" in text for text in validate_shards([tmp_path])[tmp_path])


@pytest.mark.slow
def test_many_shards_need_few_open_files(tmp_path: Path) -> None:
    import resource

    for i in range(90):
        write_shard(tmp_path / f"shard-{i:05d}.h5", samples=1, seed=i)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (100, hard))
    try:
        data = ShardDataset([tmp_path])
        assert [data[i].frame for i in range(90)] == [25 * i for i in range(90)]
        assert data[0].frame == 0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.slow
def test_flipped_bits_never_end_in_a_traceback(tmp_path: Path) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(150):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        found += bool(validate_shard(path))
    assert found > 50  # the rest hits bytes that say nothing: a small file is mostly HDF5's own slack


def test_merge(tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 7)):
        (tmp_path / name).mkdir()
        write_shard(tmp_path / name / "shard-00000.h5", seed=seed)
    summary = merge_shards([tmp_path / "a", tmp_path / "b", tmp_path / "a"], tmp_path / "both")
    assert (summary.shards, summary.images, summary.labels) == (2, 6, 12)
    assert len(summary.warnings) == 1
    assert not any(validate_shards([tmp_path / "both"]).values())
    wide = tmp_path / "c" / "shard-00000.h5"
    wide.parent.mkdir()
    with ShardWriter(wide, Pair.VP1_VP2, (36, 64)):
        pass
    with pytest.raises(DataError, match="different pairs or sizes"):
        merge_shards([tmp_path / "a", wide], tmp_path / "mixed")
    assert not (tmp_path / "mixed").exists()


@pytest.mark.parametrize("packing", [{"chunks": (100,)}, {"chunks": (64,), "compression": "gzip"}])
def test_images_that_another_program_has_packed(tmp_path: Path, packing: dict) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path)
    with ShardReader(path) as reader:
        wanted = [sample.encoded for sample in reader]

    def pack(file: h5py.File) -> None:
        data = file["images/bytes"][()]
        del file["images/bytes"]
        file.create_dataset("images/bytes", data=data, **packing)

    _edit(path, pack)
    with ShardReader(path) as reader:
        assert [sample.encoded for sample in reader] == wanted


@pytest.mark.parametrize("offset", [-5, 2**40])
def test_offsets_beyond_the_images_are_damage(tmp_path: Path, offset: int) -> None:
    path = tmp_path / "shard-00000.h5"
    write_shard(path)
    _edit(path, _set("images/offset", 1, offset))
    with ShardReader(path) as reader, pytest.raises(DataError, match="damaged"):
        reader.encoded(0)
