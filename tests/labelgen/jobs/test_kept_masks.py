"""Masks that are kept beside the shards: read again, they give the same labels."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip
from pycocotools import mask as coco_mask

from labelgen.jobs.kept_masks import KeptMasks
from labelgen.masks import InstanceMasks, create_mask_source
from labelgen.media.frames import Frame
from labelgen.shards import ShardDataset


def test_kept_masks_give_the_same_labels_again(labelgen, tmp_path: Path) -> None:
    clip = write_clip(tmp_path, 40)
    given = (
        "bcs-masks",
        clip,
        "--masks",
        f"coco:{tmp_path / 'masks.json'}",
        "--every",
        5,
        "--per-shard",
        3,
        "--rule",
        "wider",
    )
    for name, options in (("plain", ()), ("kept", ("--keep-masks",))):
        done = labelgen(*given, "--out", tmp_path / name, *options)
        assert done.returncode == 0, done.stderr
    plain, kept = (sorted((tmp_path / name).glob("*.h5")) for name in ("plain", "kept"))
    assert len(kept) == 3
    assert [path.read_bytes() for path in plain] == [path.read_bytes() for path in kept]
    assert sorted(path.name for path in (tmp_path / "kept").iterdir() if path not in kept) == [
        "dataset.json",
        "rejects.jsonl",
        "shard.masks.json",
    ]
    again = (*given[:3], f"coco:{tmp_path / 'kept' / 'shard.masks.json'}", *given[4:])
    assert labelgen(*again, "--out", tmp_path / "again").returncode == 0
    first, second = (list(ShardDataset([tmp_path / name])) for name in ("kept", "again"))
    assert [sample.frame for sample in first] == [sample.frame for sample in second]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.labels.boxes_xyxy, other.labels.boxes_xyxy)
        np.testing.assert_array_equal(one.labels.cc, other.labels.cc)
        np.testing.assert_array_equal(one.labels.class_ids, other.labels.class_ids)
    # A later job that keeps none leaves no old ones behind.
    assert labelgen(*given, "--out", tmp_path / "kept", "--overwrite").returncode == 0
    assert not list((tmp_path / "kept").glob("*.masks.json"))


def test_run_lengths_are_cocos(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    masks, wh = [], (23, 17)
    for x0, y0, x1, y1 in ((0, 0, 5, 4), (3, 2, 9, 17), (0, 0, 23, 17), (20, 10, 23, 17), (22, 16, 23, 17)):
        masks.append(np.zeros(wh[::-1], dtype=bool))
        masks[-1][y0:y1, x0:x1] = rng.random((y1 - y0, x1 - x0)) < 0.6
        masks[-1][y1 - 1, x1 - 1] = True
    instances = InstanceMasks.from_masks(wh, masks, [1] * len(masks), [1.0] * len(masks))
    frame = Frame(7, 0.28, np.zeros((*wh[::-1], 3), dtype=np.uint8))
    with KeptMasks(tmp_path, "shard", "clip") as kept:
        kept.add(0, frame, instances)
        path = kept.finish()
    annotations = json.loads(path.read_text())["annotations"]
    for annotation, mask in zip(annotations, masks, strict=True):
        expected = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
        assert annotation["segmentation"] == {"size": [17, 23], "counts": expected["counts"].decode()}
        assert annotation["area"] == mask.sum()
        assert "score" not in annotation
    again = create_mask_source(f"coco:{path}").masks([frame.image], [7], [""])[0]
    assert [again.full(i).tolist() for i in range(len(again))] == [mask.tolist() for mask in masks]


def test_nothing_half_written_stays(tmp_path: Path) -> None:
    frame = Frame(0, 0.0, np.zeros((9, 9, 3), dtype=np.uint8))
    with contextlib.suppress(KeyboardInterrupt), KeptMasks(tmp_path, "shard", "clip") as kept:
        kept.add(0, frame, InstanceMasks.empty((9, 9)))
        kept.add(1, frame, InstanceMasks.empty((9, 9)))
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["shard-00000.masks.jsonl"]
    # The run that goes on begins at the part that was interrupted.
    with KeptMasks(tmp_path, "shard", "clip") as kept:
        kept.add(1, frame, InstanceMasks.empty((9, 9)))
        kept.add(3, frame, InstanceMasks.empty((9, 9)))
        images = json.loads(kept.finish().read_text())["images"]
    assert [image["id"] for image in images] == [1, 2, 3]


@pytest.mark.parametrize("damage", ["cut", "missing", "empty", "not JSON"])
def test_a_damaged_part_of_kept_masks_is_made_again(tmp_path: Path, damage: str) -> None:
    folder = tmp_path / "parts"
    folder.mkdir()
    frame = np.zeros((8, 8, 3), np.uint8)
    masks = InstanceMasks.empty((8, 8))
    with KeptMasks(folder, "shard", "clip") as kept:
        for number in range(6):
            kept.add(number // 2, Frame(number, number / 10, frame), masks)
        assert KeptMasks(folder, "shard", "clip").complete_parts() == 2
        kept.finish()
    assert KeptMasks(folder, "shard", "clip").complete_parts() == 3
    assert len(json.loads((folder / "shard.masks.json").read_text())["images"]) == 6
    part = folder / "shard-00001.masks.jsonl"
    text = part.read_text()
    part.unlink()
    if damage != "missing":
        part.write_text({"cut": text[:40], "empty": "", "not JSON": "[1, 2]\n"}[damage])
    assert KeptMasks(folder, "shard", "clip").complete_parts() == 1
