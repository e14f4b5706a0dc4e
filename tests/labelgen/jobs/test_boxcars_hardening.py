"""BoxCars116k trees with damaged or unusual entries, and what identifies a job on them."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from boxcars_trees import write_tree

from labelgen.choices import Pair
from labelgen.datasets.boxcars116k import BoxCars
from labelgen.datasets.manifest import load_manifest
from labelgen.errors import DataError
from labelgen.jobs.boxcars import boxcars_job
from labelgen.jobs.runner import run_job
from labelgen.labels import Split
from labelgen.shards import DatasetSummary

LAYOUT = load_manifest("boxcars116k")["layout"]
HUGE = 10**400


def _open(root: Path, split: str | None = None) -> BoxCars:
    return BoxCars(root, LAYOUT, split, default_split="hard")


def _job(root: Path, **options: Any) -> Any:
    return boxcars_job(_open(root), Pair.VP2_VP3, (320, 180), to_camera_only=False, **options)


def _run(root: Path, out: Path) -> DatasetSummary:
    return run_job(_job(root), out)


def _rejects(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "rejects.jsonl").read_text(encoding="utf-8").splitlines()]


def _plain(data: Any) -> Any:
    return json.loads(json.dumps(data, default=lambda a: a.tolist()))


def _write(root: Path, data: Any, kind: str) -> None:
    (root / "dataset.pkl").unlink(missing_ok=True)
    if kind == "pkl":
        (root / "dataset.pkl").write_bytes(pickle.dumps(data, protocol=2))
    else:
        (root / "json_data").mkdir(exist_ok=True)
        (root / "json_data" / "dataset.json").write_text(json.dumps(data))


def _set(*keys: Any, value: Any) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


FIRST = ("samples", 0, "instances", 0)
# The change, the rejects, and how many of 12 labels remain.
BROKEN: list[tuple[Callable[[Any], None], dict[str, int], int]] = [
    (_set(*FIRST, "3DBB", 0, 0, value=HUGE), {"damaged entry": 1}, 11),
    (_set(*FIRST, "3DBB_offset", value=[HUGE, 0]), {"damaged entry": 1}, 11),
    (_set(*FIRST, "3DBB_offset", value=[[1], [2, 3]]), {"damaged entry": 1}, 11),
    (_set(*FIRST, "path", value="a\0b.png"), {"damaged entry": 1}, 11),
    (_set(*FIRST, "path", value="a\ud800b.png"), {"damaged entry": 1}, 11),
    (_set(*FIRST, value="nothing"), {"damaged entry": 1}, 11),
    (_set("samples", 0, "camera", value="a\ud800\0"), {"no usable camera": 2}, 10),
    (_set("samples", 0, "instances", value="abc"), {"damaged entry": 1}, 10),
    (_set("samples", 0, "instances", value={"a": 1}), {"damaged entry": 1}, 10),
    (_set("samples", 0, value=None), {"damaged entry": 1}, 10),
    # Vehicles 0 and 3 of two instances each are of camera alpha.
    (_set("cameras", "alpha", "vp1", value=[HUGE, 1]), {"no usable camera": 4}, 8),
    (_set("cameras", "alpha", "scale", value=HUGE), {"no usable camera": 4}, 8),
    (_set("cameras", "alpha", "vp3", value="x"), {"no usable camera": 4}, 8),
    (_set("cameras", "alpha", "vp3", value=[[1], [2, 3]]), {"no usable camera": 4}, 8),
    (_set("cameras", "alpha", "vp3", value=[HUGE, 1]), {"no usable camera": 4}, 8),
    (_set("cameras", "a\ud800\0", value={}), {}, 12),
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pkl", "json"])
@pytest.mark.parametrize(("change", "reasons", "labels"), BROKEN, ids=range(len(BROKEN)))
def test_damaged_values_reject_only_their_instances(
    tmp_path: Path, change: Callable[[Any], None], reasons: dict[str, int], labels: int, kind: str
) -> None:
    data = _plain(write_tree(tmp_path / "tree", vehicles=6, per_vehicle=2, atlas=False))
    change(data)
    _write(tmp_path / "tree", data, kind)
    summary = _run(tmp_path / "tree", tmp_path / "out")
    assert (dict(summary.reasons), summary.labels) == (reasons, labels)
    for line in _rejects(tmp_path / "out"):
        assert line["detail"]
        assert "\0" not in line["source"]


def test_json_too_deep_to_read_gives_one_error_line(tmp_path: Path) -> None:
    write_tree(tmp_path, vehicles=1, pkl=False, atlas=False)
    (tmp_path / "json_data" / "dataset.json").write_text("[" * 100_000)
    with pytest.raises(DataError, match=r"dataset\.json: not JSON") as caught:
        _open(tmp_path)
    assert "\n" not in str(caught.value)


def _objects(items: list[Any]) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


@pytest.mark.parametrize("sequence", [tuple, _objects])
def test_lists_may_be_tuples_or_arrays(tmp_path: Path, sequence: Callable[[list[Any]], Any]) -> None:
    data = write_tree(tmp_path / "tree", vehicles=6, json=False, atlas=False)
    for sample in data["samples"]:
        sample["instances"] = sequence(sample["instances"])
    data["samples"] = sequence(data["samples"])
    _write(tmp_path / "tree", data, "pkl")
    assert _run(tmp_path / "tree", tmp_path / "out").labels == 18


def test_cameras_are_the_same_as_numbers_and_as_text(tmp_path: Path) -> None:
    data = write_tree(tmp_path / "tree", vehicles=6, json=False, atlas=False)
    data["cameras"] = {n: data["cameras"][name] for n, name in enumerate(("alpha", "beta", "uvoz"))}
    for v, sample in enumerate(data["samples"]):
        sample["camera"] = str(v % 3)
    _write(tmp_path / "tree", data, "pkl")
    assert _run(tmp_path / "tree", tmp_path / "out").labels == 18


def test_boxes_outside_and_tiny_crops_are_rejects(tmp_path: Path) -> None:
    data = write_tree(tmp_path / "tree", vehicles=6, per_vehicle=1, json=False, atlas=False)
    entries = [sample["instances"][0] for sample in data["samples"]]
    sides = np.ptp(entries[0]["3DBB"], axis=0)
    entries[0]["3DBB_offset"] = entries[0]["3DBB_offset"] - [0, 700]
    entries[1]["3DBB_offset"] = entries[1]["3DBB_offset"] + [700, 0]
    entries[2]["3DBB_offset"] = entries[2]["3DBB_offset"] + sides * [0.1, 0]  # cut, but most of it is there
    for entry, wh in ((entries[3], (7, 40)), (entries[4], (40, 7))):
        cv2.imwrite(str(tmp_path / "tree" / "images" / entry["path"]), np.zeros((wh[1], wh[0], 3), np.uint8))
    _write(tmp_path / "tree", data, "pkl")
    summary = _run(tmp_path / "tree", tmp_path / "out")
    reasons = {line["source"]: line["reason"] for line in _rejects(tmp_path / "out")}
    assert reasons == {
        entries[0]["path"]: "outside the picture",
        entries[1]["path"]: "outside the picture",
        entries[3]["path"]: "picture too small",
        entries[4]["path"]: "picture too small",
    }
    assert summary.labels == 2


def _splits(root: Path, hard: range, easy: range) -> None:
    data = {
        name: {"train": [(v, 0) for v in members], "validation": [], "test": []}
        for name, members in (("hard", hard), ("easy", easy))
    }
    (root / "classification_splits.pkl").write_bytes(pickle.dumps(data, protocol=2))


def test_the_split_is_part_of_the_job(tmp_path: Path) -> None:
    write_tree(tmp_path, vehicles=4, json=False, atlas=False)
    _splits(tmp_path, range(2), range(1, 3))
    hard, easy = (boxcars_job(_open(tmp_path, s), Pair.VP2_VP3, (320, 180)).describe() for s in (None, "easy"))
    assert (hard["settings"]["split"], easy["settings"]["split"]) == ("hard", "easy")
    assert hard["inputs"] == easy["inputs"]
    assert _open(tmp_path, "easy").split_of(2) is Split.TRAIN
    _splits(tmp_path, range(2), range(3))
    changed = _job(tmp_path).describe()
    assert changed["inputs"].keys() == hard["inputs"].keys()
    assert changed["inputs"]["classification_splits.pkl"] != hard["inputs"]["classification_splits.pkl"]
    (tmp_path / "classification_splits.pkl").unlink()
    without = _job(tmp_path).describe()
    assert without["settings"]["split"] is None
    assert "classification_splits.pkl" not in without["inputs"]


def test_the_atlas_is_part_of_the_job(tmp_path: Path) -> None:
    write_tree(tmp_path, vehicles=2, json=False, images=False)
    before = _job(tmp_path).describe()["inputs"]
    assert before == _job(tmp_path).describe()["inputs"]
    content = (tmp_path / "atlas.pkl").read_bytes()
    atlas = pickle.loads(content)
    atlas[1][0][-3] ^= 1
    (tmp_path / "atlas.pkl").write_bytes(pickle.dumps(atlas, protocol=2))
    after = _job(tmp_path).describe()["inputs"]
    assert {key for key in before if before[key] != after[key]} == {"atlas.pkl"}
    assert after["atlas.pkl"].startswith(f"{len(content)} ")


@pytest.mark.parametrize("split", [{"train": [(float("inf"), 0)], "validation": [], "test": []}, {"train": 3}, [1]])
def test_damaged_splits_give_one_error_line(tmp_path: Path, split: Any) -> None:
    write_tree(tmp_path, vehicles=1, json=False, atlas=False)
    (tmp_path / "classification_splits.pkl").write_bytes(pickle.dumps({"hard": split}, protocol=2))
    with pytest.raises(DataError, match="split 'hard' is not of the form"):
        _open(tmp_path)


@pytest.mark.parametrize(
    "crop", [np.zeros((4, 4), np.uint8)[:, ::2], "text", 3, None, np.array([None, 1], dtype=object), b"no picture"]
)
def test_an_atlas_entry_that_is_no_picture_rejects_only_its_instance(tmp_path: Path, crop: Any) -> None:
    write_tree(tmp_path / "tree", vehicles=2, json=False, images=False)
    path = tmp_path / "tree" / "atlas.pkl"
    atlas = pickle.loads(path.read_bytes())
    atlas[1][0] = crop
    path.write_bytes(pickle.dumps(atlas, protocol=2))
    summary = _run(tmp_path / "tree", tmp_path / "out")
    assert summary.reasons == {"unreadable picture": 1}
    assert summary.labels == 5
