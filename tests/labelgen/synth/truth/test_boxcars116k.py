"""Synthetic BoxCars trees: the published layout, and boxes that are exact."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from labelgen.cli.synth import synth_app
from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, cuboid_sizes

pytestmark = pytest.mark.slow


def write(out: Path, *more: str) -> None:
    arguments = ["boxcars", "--out", str(out), "--vehicles", "4", "--seed", "2", *more]
    result = CliRunner().invoke(synth_app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("boxcars")
    write(out)
    return out


@pytest.fixture(scope="module")
def dataset(root: Path) -> dict:
    return load_pickle(root / "dataset.pkl")


def test_pickle_and_json_hold_the_same(root: Path, dataset: dict) -> None:
    assert json.loads((root / "json_data" / "dataset.json").read_text(encoding="utf-8")) == dataset


def test_samples_have_the_published_fields(dataset: dict) -> None:
    assert len(dataset["samples"]) == 4
    assert {s["camera"] for s in dataset["samples"]} == set(dataset["cameras"]) >= {"uvoz"}
    assert {s["to_camera"] for s in dataset["samples"]} == {True, False}
    for sample in dataset["samples"]:
        assert len(sample["instances"]) >= 2
        for instance in sample["instances"]:
            assert set(instance) == {"2DBB", "3DBB", "3DBB_offset", "instance_id", "path"}


def test_crops_hold_their_boxes_in_files_and_atlas(root: Path, dataset: dict) -> None:
    atlas = load_pickle(root / "atlas.pkl")
    for sample, jpegs in zip(dataset["samples"], atlas, strict=True):
        for instance, jpeg in zip(sample["instances"], jpegs, strict=True):
            crop = cv2.imread(str(root / "images" / instance["path"]))
            again = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
            assert again.shape == crop.shape
            assert np.abs(again.astype(int) - crop).mean() < 4
            inside = np.array(instance["3DBB"]) - instance["3DBB_offset"]
            assert (inside > 0).all()
            assert (inside < crop.shape[1::-1]).all()
            x, y, w, h = instance["2DBB"]
            np.testing.assert_allclose([x, y], np.min(instance["3DBB"], axis=0))
            np.testing.assert_allclose([x + w, y + h], np.max(instance["3DBB"], axis=0))


def test_boxes_point_to_the_vanishing_points_front_first(dataset: dict) -> None:
    for sample in dataset["samples"]:
        camera = dataset["cameras"][sample["camera"]]
        for instance in sample["instances"]:
            v = np.array(instance["3DBB"])
            for edges, vp in (((1, 2), "vp1"), ((0, 1), "vp2"), ((0, 4), "vp3")):
                a, b, far = v[edges[0]], v[edges[1]], np.array(camera[vp])
                off = np.cross(np.append(b - a, 0), np.append(far - a, 0))[2] / np.linalg.norm(far - a)
                assert abs(off) < 0.02
            nearer_front = v[4:6, 1].mean() > v[6:8, 1].mean()
            assert nearer_front == sample["to_camera"]


def test_a_vehicle_keeps_its_size(dataset: dict) -> None:
    for sample in dataset["samples"]:
        entry = dataset["cameras"][sample["camera"]]
        camera = Camera(entry["vp1"], entry["vp2"], entry["pp"], 1.0)
        sizes = cuboid_sizes([i["3DBB"] for i in sample["instances"]], camera)
        np.testing.assert_allclose(sizes, np.tile(sizes[0], (len(sizes), 1)), rtol=0.01)


def test_splits_name_every_vehicle_once(root: Path, dataset: dict) -> None:
    split = load_pickle(root / "classification_splits.pkl")["body"]
    named = [vehicle for part in ("train", "validation", "test") for vehicle, _ in split[part]]
    assert sorted(named) == list(range(len(dataset["samples"])))
    for part in ("train", "validation", "test"):
        for vehicle, label in split[part]:
            assert split["types_mapping"][dataset["samples"][vehicle]["annotation"]] == label


def test_same_seed_same_bytes(root: Path, tmp_path: Path) -> None:
    write(tmp_path)
    files = sorted(p.relative_to(root) for p in root.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    for name in files:
        assert (root / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_nothing_is_replaced_unasked(root: Path) -> None:
    with pytest.raises(LabelgenError, match="holds a data set already"):
        write(root)
