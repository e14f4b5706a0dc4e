"""`labelgen boxcars` on trees of the BoxCars116k layout: counts, identity, round trip, resumption."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from boxcars_trees import CAMERAS, write_tree

from labelgen.errors import DataError
from labelgen.labels import Flag, Split
from labelgen.shards import ShardDataset, ShardReader, validate_shards

EVERYTHING = ("--cameras", "all", "--all-directions")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("trees") / "BoxCars116k"
    write_tree(root)
    return root


def _hashes(folder: Path) -> list[str]:
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("shard-*.h5"))]


def _run(labelgen, tree: Path, out: Path, *options: object) -> dict:
    report = out.parent / f"{out.name}.json"
    done = labelgen("boxcars", "--root", tree, "--out", out, "--json", report, *options)
    assert done.returncode == 0, done.stderr
    return json.loads(report.read_text())


@pytest.mark.parametrize("options", [(), EVERYTHING, ("--cameras", "alpha,beta"), ("--pair", "VP1-VP2", *EVERYTHING)])
def test_every_instance_is_a_label_or_a_reject(labelgen, tree: Path, tmp_path: Path, options) -> None:
    report = _run(labelgen, tree, tmp_path / "out", *options)
    assert report["labels"] == report["images"]
    assert report["labels"] + report["rejects"] == 36
    lines = (tmp_path / "out" / "rejects.jsonl").read_text().splitlines()
    assert len(lines) == report["rejects"] == sum(report["rejects_by_reason"].values())
    assert not any(validate_shards([tmp_path / "out"]).values())
    named = {json.loads(line)["source"] for line in lines} | {s.source for s in ShardDataset([tmp_path / "out"])}
    assert len(named) == 36


def test_published_exclusions_are_the_default(labelgen, tree: Path, tmp_path: Path) -> None:
    report = _run(labelgen, tree, tmp_path / "out")
    # 12 vehicles of 3 cameras in turn, 3 instances each; uvoz is excluded; vehicles 3, 7 and 11 drive away.
    assert report["rejects_by_reason"] == {"camera left out": 12, "drives away from the camera": 6}
    assert {camera.name for r in ShardDataset([tmp_path / "out"]).readers for camera in r.cameras} == {"alpha", "beta"}


@pytest.mark.parametrize("pair", ["VP2-VP3", "VP1-VP2"])
def test_labels_give_back_the_source_boxes(labelgen, tree: Path, tmp_path: Path, pair: str) -> None:
    _run(labelgen, tree, tmp_path / "out", "--pair", pair, *EVERYTHING)
    data = pickle.loads((tree / "dataset.pkl").read_bytes())
    boxes = {entry["path"]: entry["3DBB"] for sample in data["samples"] for entry in sample["instances"]}
    samples = list(ShardDataset([tmp_path / "out"]))
    assert len(samples) == 36
    for sample in samples:
        vertices, valid = sample.vertices_px()
        assert valid.all()
        assert np.abs(vertices[0] - boxes[sample.source]).max() < 0.05
        assert sample.image.shape[1::-1] == ((320, 180) if pair == "VP2-VP3" else (180, 320))
        assert not sample.labels.has(Flag.MISALIGNED).any()
    away = [bool(s.labels.has(Flag.REVERSED)[0]) for s in samples]
    assert sum(away) == 9


def test_crops_are_warped_to_where_their_labels_are(labelgen, tree: Path, tmp_path: Path) -> None:
    """The painted silhouette of each crop fills its label's box to within two pixels."""
    _run(labelgen, tree, tmp_path / "out", "--quality", 0, *EVERYTHING)
    for sample in ShardDataset([tmp_path / "out"]):
        vertices, _ = sample.labels.vertices(sample.rectification.vpu)
        inside = np.zeros(sample.image.shape[:2], np.uint8)
        cv2.fillConvexPoly(inside, cv2.convexHull(vertices[0].astype(np.float32)).astype(np.int32), 1)
        core = cv2.erode(inside, np.ones((7, 7), np.uint8)).astype(bool)
        assert sample.image[core].std(axis=0).max() < 3  # one plain colour, nothing of the noise around it


def test_pickle_and_json_trees_give_identical_shards(labelgen, tmp_path: Path) -> None:
    for name, parts in (("pkl", {"json": False}), ("json", {"pkl": False})):
        write_tree(tmp_path / name, vehicles=4, **parts)
        _run(labelgen, tmp_path / name, tmp_path / f"out-{name}", *EVERYTHING)
    assert _hashes(tmp_path / "out-pkl") == _hashes(tmp_path / "out-json")


def test_atlas_and_images_agree_up_to_jpeg(labelgen, tmp_path: Path) -> None:
    for name, parts in (("images", {"atlas": False}), ("atlas", {"images": False})):
        write_tree(tmp_path / name, vehicles=4, **parts)
        _run(labelgen, tmp_path / name, tmp_path / f"out-{name}", *EVERYTHING)
    from_images, from_atlas = (list(ShardDataset([tmp_path / f"out-{name}"])) for name in ("images", "atlas"))
    assert len(from_images) == len(from_atlas) == 12
    for a, b in zip(from_images, from_atlas, strict=True):
        np.testing.assert_array_equal(a.labels.boxes_xyxy, b.labels.boxes_xyxy)
        np.testing.assert_array_equal(a.labels.cc, b.labels.cc)
        assert np.abs(a.image.astype(int) - b.image).mean() < 3


def test_splits_are_stored(labelgen, tree: Path, tmp_path: Path) -> None:
    _run(labelgen, tree, tmp_path / "out", *EVERYTHING)
    seen = {int(s.source.split("/")[1]): s.split for s in ShardDataset([tmp_path / "out"])}
    assert seen == {v: Split.TRAIN if v % 2 == 0 else Split.VALIDATION if v == 1 else Split.TEST for v in range(12)}


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_bytes(labelgen, tree: Path, tmp_path: Path) -> None:
    for workers in (1, 2):
        _run(labelgen, tree, tmp_path / f"out{workers}", "--per-shard", 7, "--workers", workers, *EVERYTHING)
    assert len(_hashes(tmp_path / "out1")) == 6
    assert _hashes(tmp_path / "out1") == _hashes(tmp_path / "out2")


def test_limit(labelgen, tree: Path, tmp_path: Path) -> None:
    assert _run(labelgen, tree, tmp_path / "out", "--limit", 5, *EVERYTHING)["images"] == 5


def _break(tree: Path) -> dict[str, str]:
    """Damage one instance in each way; returns reason by path."""
    data = pickle.loads((tree / "dataset.pkl").read_bytes())
    entries = [entry for sample in data["samples"] for entry in sample["instances"]]
    expected = {}
    (tree / "images" / entries[0]["path"]).unlink()
    expected[entries[0]["path"]] = "unreadable picture"
    (tree / "images" / entries[1]["path"]).write_bytes(b"no picture")
    expected[entries[1]["path"]] = "unreadable picture"
    entries[2]["3DBB"] = entries[2]["3DBB"][:5]
    expected[entries[2]["path"]] = "damaged entry"
    entries[3]["3DBB"][0, 0] = np.nan
    expected[entries[3]["path"]] = "damaged entry"
    del entries[4]["3DBB_offset"]
    expected["vehicle 1"] = "damaged entry"
    entries[5]["path"] = "../../outside.png"
    expected[entries[5]["path"]] = "damaged entry"
    entries[6]["3DBB"][[0, 1, 2, 3]] = entries[6]["3DBB"][[4, 5, 6, 7]]
    expected[entries[6]["path"]] = "no valid 3D box"
    entries[7]["3DBB"] = np.tile(entries[7]["3DBB"][:1], (8, 1))
    expected[entries[7]["path"]] = "no valid 3D box"
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    entries[8]["3DBB"] = (entries[8]["3DBB"] - entries[8]["3DBB"].mean(0)) @ turn + entries[8]["3DBB"].mean(0)
    expected[entries[8]["path"]] = "box against the vanishing points"
    data["samples"][3]["camera"] = "unknown"
    expected.update({entry["path"]: "no usable camera" for entry in data["samples"][3]["instances"]})
    (tree / "dataset.pkl").write_bytes(pickle.dumps(data, protocol=2))
    return expected


def test_bad_instances_become_rejects(labelgen, tmp_path: Path) -> None:
    write_tree(tmp_path / "tree", vehicles=6, json=False, atlas=False)
    expected = _break(tmp_path / "tree")
    report = _run(labelgen, tmp_path / "tree", tmp_path / "out", *EVERYTHING)
    lines = [json.loads(line) for line in (tmp_path / "out" / "rejects.jsonl").read_text().splitlines()]
    assert {line["source"]: line["reason"] for line in lines} == expected
    assert all(line["detail"] for line in lines)
    assert report["labels"] == 18 - len(lines)


def test_an_impossible_camera_rejects_only_its_own_instances(labelgen, tmp_path: Path) -> None:
    write_tree(tmp_path / "tree", vehicles=6, json=False, atlas=False)
    path = tmp_path / "tree" / "dataset.pkl"
    data = pickle.loads(path.read_bytes())
    data["cameras"]["beta"]["vp2"] = data["cameras"]["beta"]["vp1"]
    path.write_bytes(pickle.dumps(data, protocol=2))
    report = _run(labelgen, tmp_path / "tree", tmp_path / "out", *EVERYTHING)
    assert report["rejects_by_reason"] == {"no usable camera": 6}
    assert "cannot be orthogonal" in (tmp_path / "out" / "rejects.jsonl").read_text()


def test_a_finished_data_set_is_not_replaced_unasked(labelgen, tree: Path, tmp_path: Path) -> None:
    _run(labelgen, tree, tmp_path / "out", *EVERYTHING)
    before = _hashes(tmp_path / "out")
    done = labelgen("boxcars", "--root", tree, "--out", tmp_path / "out", "--limit", 3)
    assert done.returncode == 2
    assert "already holds a finished data set; overwrite it or choose another folder" in done.stderr
    assert "(options --overwrite, --out)" in done.stderr
    assert _hashes(tmp_path / "out") == before
    note = tmp_path / "out" / "notes.txt"
    note.write_text("mine")
    _run(labelgen, tree, tmp_path / "out", "--limit", 3, "--overwrite", *EVERYTHING)
    assert _hashes(tmp_path / "out") != before
    assert note.read_text() == "mine"


@pytest.mark.slow
def test_killed_at_any_moment_it_goes_on_and_ends_the_same(labelgen_process, tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    write_tree(tree, vehicles=60, per_vehicle=4, json=False, atlas=False)
    options = ("--per-shard", 12, "--workers", 1, *EVERYTHING)
    start = time.perf_counter()
    _run(labelgen_process, tree, tmp_path / "whole", *options)
    whole = time.perf_counter() - start
    wanted = _hashes(tmp_path / "whole")
    assert len(wanted) == 20
    rng = np.random.default_rng(1)
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "labelgen",
        "boxcars",
        "--root",
        tree,
        "--out",
        out,
    ]
    interrupted = 0
    for _ in range(10):
        process = subprocess.Popen([*map(str, command), *map(str, options)], stderr=subprocess.DEVNULL)
        try:
            process.wait(timeout=rng.uniform(0.3, 1.0) * whole)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            interrupted += 1
        for path in out.rglob("*.h5"):
            assert len(ShardReader(path)) == 12
        if (out / "dataset.json").exists():
            assert _hashes(out) == wanted
            shutil.rmtree(out)
    assert interrupted >= 3
    if not (out / "dataset.json").exists():
        _run(labelgen_process, tree, out, *options)
    assert _hashes(out) == wanted
    assert (out / "dataset.json").read_bytes() == (tmp_path / "whole" / "dataset.json").read_bytes()
    assert {path.name for path in out.iterdir()} == {path.name for path in (tmp_path / "whole").iterdir()}


def _unfinish(out: Path, lose: str) -> Path:
    """Put a finished data set back to where a job is when one shard is missing."""
    staged = out / ".labelgen-job"
    staged.mkdir()
    index = json.loads((out / "dataset.json").read_text())
    (staged / "job.json").write_text(json.dumps(index["job"]))
    for path in out.glob("shard-*.h5"):
        path.rename(staged / path.name)
    (out / "dataset.json").unlink()
    (out / "rejects.jsonl").unlink()
    (staged / lose).unlink()
    return staged


@pytest.mark.slow
def test_an_unfinished_job_with_other_settings_needs_overwrite(labelgen, tree: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    _run(labelgen, tree, out, "--per-shard", 7, *EVERYTHING)
    wanted = _hashes(out)
    staged = _unfinish(out, "shard-00002.h5")
    for options in (("--per-shard", 8, *EVERYTHING), ("--per-shard", 7, "--quality", 90, *EVERYTHING)):
        done = labelgen("boxcars", "--root", tree, "--out", out, *options)
        assert done.returncode == 2
        assert "unfinished job with other settings" in done.stderr
        assert len(_hashes(staged)) == 5
    report = _run(labelgen, tree, out, "--per-shard", 7, *EVERYTHING)
    assert report["warnings"] == ["went on with an interrupted job: 5 shards were there"]
    assert _hashes(out) == wanted
    assert not staged.exists()


@pytest.mark.slow
def test_a_damaged_leftover_is_made_again(labelgen, tree: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    _run(labelgen, tree, out, "--per-shard", 7, *EVERYTHING)
    wanted = _hashes(out)
    staged = _unfinish(out, "shard-00005.h5")
    for name, keep in (("shard-00000.h5", None), ("shard-00001.h5", 3000)):
        data = bytearray((staged / name).read_bytes()[:keep])
        data[data.find(b"\xff\xd8\xff") + 300] ^= 0xFF
        (staged / name).write_bytes(data)
    report = _run(labelgen, tree, out, "--per-shard", 7, *EVERYTHING)
    assert report["warnings"] == ["went on with an interrupted job: 3 shards were there"]
    assert _hashes(out) == wanted


def test_the_old_data_set_stays_when_the_new_job_fails(labelgen, tree: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    _run(labelgen, tree, out, *EVERYTHING)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    empty = tmp_path / "empty"
    write_tree(empty, vehicles=1, atlas=False)
    for path in (empty / "images").rglob("*.png"):
        path.write_bytes(b"")
    done = labelgen("boxcars", "--root", empty, "--out", out, "--overwrite", *EVERYTHING)
    assert done.returncode == 2
    assert "3 x unreadable picture" in done.stderr
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.slow
def test_a_publication_that_was_killed_is_completed(labelgen, tree: Path, tmp_path: Path) -> None:
    """The state after a kill between two renames, made by hand from an old and a new data set."""
    old, new = tmp_path / "old", tmp_path / "new"
    _run(labelgen, tree, old, "--per-shard", 5, "--pair", "VP1-VP2", *EVERYTHING)
    _run(labelgen, tree, new, "--per-shard", 7, *EVERYTHING)
    wanted = _hashes(new)
    staged = old / ".labelgen-job"
    staged.mkdir()
    (old / "dataset.json").unlink()
    (staged / "job.json").write_text(json.dumps(json.loads((new / "dataset.json").read_text())["job"]))
    for i, path in enumerate(sorted(new.iterdir(), reverse=True)):
        path.rename((old if path.name == "shard-00001.h5" and i else staged) / path.name)
    report = _run(labelgen, tree, old, "--per-shard", 7, "--overwrite", *EVERYTHING)
    assert report["labels"] == 36
    assert _hashes(old) == wanted
    assert not any(validate_shards([old]).values())


@pytest.mark.skipif(sys.platform == "win32", reason="needs file locks")
def test_two_jobs_do_not_share_a_folder(labelgen, tree: Path, tmp_path: Path) -> None:
    import fcntl

    staged = tmp_path / "out" / ".labelgen-job"
    staged.mkdir(parents=True)
    with (staged / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = labelgen("boxcars", "--root", tree, "--out", tmp_path / "out", *EVERYTHING)
    assert done.returncode == 2
    assert "another labelgen job is writing into it" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    write_tree(tmp_path / "tree", vehicles=150, per_vehicle=4, json=False, atlas=False)
    command = [
        sys.executable,
        "-m",
        "labelgen",
        "boxcars",
        "--root",
        "tree",
        "--out",
        "out",
    ]
    process = subprocess.Popen(
        [*command, *EVERYTHING, "--per-shard", "20", "--workers", "2"], cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    staged = tmp_path / "out" / ".labelgen-job"
    deadline = time.monotonic() + 60
    while not any(staged.glob("shard-*.h5")) and time.monotonic() < deadline:
        os.sched_yield()
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert children
    while any(Path(f"/proc/{child}").exists() for child in children) and time.monotonic() < deadline:
        os.sched_yield()
    assert not any(Path(f"/proc/{child}").exists() for child in children)


def test_cameras_of_the_tree_are_real_ones() -> None:
    for camera in CAMERAS.values():
        assert 5 < camera.height_m < 15


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="needs Linux")
def test_damaged_annotations_give_one_error_line(tmp_path: Path) -> None:
    from labelgen.datasets.boxcars116k import BoxCars
    from labelgen.datasets.manifest import load_manifest

    layout = load_manifest("boxcars116k")["layout"]
    (tmp_path / "images").mkdir()
    for content, message in (
        ({"samples": []}, "expected 'cameras' and 'samples'"),
        ([1, 2], "expected 'cameras' and 'samples'"),
    ):
        (tmp_path / "dataset.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(DataError, match=message):
            BoxCars(tmp_path, layout)
