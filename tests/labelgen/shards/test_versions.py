"""Shards of version 1, which earlier labelgens wrote: they are read, checked and merged with newer ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from samples import write_shard

from labelgen.jobs.runner import finished_part
from labelgen.shards import ShardDataset, ShardReader, merge_shards, validate_shard, validate_shards, write_index

VERSION_1 = Path(__file__).with_name("version-1.h5")
"""Written by labelgen 0.1.0 before version 2: two samples with one and two labels, one reject."""


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A data set of version 1."""
    folder = tmp_path / "old"
    folder.mkdir()
    shutil.copy(VERSION_1, folder / "shard-00000.h5")
    write_index(folder, [folder / "shard-00000.h5"], {"command": "test"})
    return folder


def test_version_1_is_read_with_nothing_ignored_and_nothing_known(old: Path) -> None:
    with ShardReader(old / "shard-00000.h5") as reader:
        assert reader.attributes["version"] == 1
        assert [len(sample.labels) for sample in reader] == [1, 2]
        assert [len(sample.ignored) for sample in reader] == [0, 0]
        for sample in reader:
            assert sample.labels.sigmas.shape == (len(sample.labels), 5)
            assert np.isnan(sample.labels.sigmas).all()
            assert np.isnan(sample.labels.hidden).all()
            assert sample.image.shape == (36, 64, 3)
        assert reader.rejects[0].reason == "too small"
    assert validate_shard(VERSION_1) == []
    assert json.loads((old / "dataset.json").read_text())["version"] == 1
    assert not any(validate_shards([old]).values())


def test_version_1_and_2_merge_to_version_2(tmp_path: Path, old: Path) -> None:
    new = tmp_path / "new" / "shard-00000.h5"
    new.parent.mkdir()
    write_shard(new, seed=4)
    summary = merge_shards([old, new.parent, old], tmp_path / "both")
    assert (summary.shards, summary.images, summary.labels, summary.rejects) == (2, 5, 9, 2)
    assert not any(validate_shards([tmp_path / "both"]).values())
    assert json.loads((tmp_path / "both" / "dataset.json").read_text())["version"] == 2
    merged = ShardDataset([tmp_path / "both"])
    assert [reader.attributes["version"] for reader in merged.readers] == [2, 2]
    for before, after in zip([*ShardReader(VERSION_1), *ShardReader(new)], merged, strict=True):
        assert after.encoded == before.encoded
        assert (after.source, after.frame, after.time_s) == (before.source, before.frame, before.time_s)
        assert after.labels.boxes_xyxy.tolist() == before.labels.boxes_xyxy.tolist()
        assert after.labels.cc.tolist() == before.labels.cc.tolist()
        assert after.ignored.boxes_xyxy.tolist() == before.ignored.boxes_xyxy.tolist()
    # A shard and what became of it are the same content.
    again = merge_shards([tmp_path / "both", old], tmp_path / "again")
    assert (again.shards, again.images) == (2, 5)
    for name in ("shard-00000.h5", "shard-00001.h5"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "both" / name).read_bytes()


@pytest.mark.parametrize("command", [["inspect"], ["validate"], ["audit", "--out", "page"]])
def test_commands_take_version_1(labelgen, old: Path, command: list[str]) -> None:
    done = labelgen(command[0], old, *command[1:])
    assert done.returncode == 0, done.stderr


def test_a_job_that_goes_on_makes_shards_of_version_1_again(tmp_path: Path) -> None:
    assert finished_part(VERSION_1, source="clip", part=0) is None
    write_shard(tmp_path / "shard-00000.h5")
    assert finished_part(tmp_path / "shard-00000.h5", source="clip", part=0) is not None
