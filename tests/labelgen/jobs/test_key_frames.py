"""`bcs-masks --keyframes`: frames that decode alone, with the numbers of the whole video; what is left undecoded."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from clips import write_clip

from labelgen.shards import ShardDataset


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips"))  # a key frame each 12


@pytest.mark.parametrize(
    ("options", "frames"),
    [
        ((), [0, 36]),  # 25 frames or more apart, by default
        (("--every", 1), [0, 12, 24, 36, 48]),
        (("--every", 13), [0, 24, 48]),
        (("--every", 1, "--limit", 2), [0, 12]),
        (("--every", 12, "--per-shard", 2), [0, 12, 24, 36, 48]),
    ],
)
def test_key_frames_and_their_labels(labelgen, clip: Path, tmp_path: Path, options: tuple, frames: list[int]) -> None:
    masks = ("--masks", f"coco:{clip.parent / 'masks.json'}")
    done = labelgen("bcs-masks", clip, *masks, "--rule", "wider", "--keyframes", *options, "--out", "keys")
    assert done.returncode == 0, done.stderr
    done = labelgen("bcs-masks", clip, *masks, "--rule", "wider", "--every", 6, "--out", "all")
    assert done.returncode == 0, done.stderr
    expected = {sample.frame: sample for sample in ShardDataset([tmp_path / "all"])}
    samples = list(ShardDataset([tmp_path / "keys"]))
    assert [sample.frame for sample in samples] == frames
    for sample in samples:
        other = expected[sample.frame]
        assert sample.time_s == other.time_s
        np.testing.assert_array_equal(sample.image, other.image)
        np.testing.assert_array_equal(sample.labels.boxes_xyxy, other.labels.boxes_xyxy)
    # The same frames are found again for an audit.
    assert labelgen("audit", "keys", "--out", "audit").returncode == 0
    if "--per-shard" in options:
        assert len(list((tmp_path / "keys").glob("*.h5"))) == 3


def test_key_frames_are_another_job(labelgen, clip: Path, tmp_path: Path) -> None:
    arguments = ("bcs-masks", clip, "--masks", f"coco:{clip.parent / 'masks.json'}", "--every", 12, "--out", "out")
    assert labelgen(*arguments).returncode == 0
    assert "keyframes" not in ShardDataset([tmp_path / "out"]).readers[0].settings
    assert labelgen(*arguments, "--keyframes").returncode == 2
    assert labelgen(*arguments, "--keyframes", "--overwrite").returncode == 0
    assert ShardDataset([tmp_path / "out"]).readers[0].settings["keyframes"] is True


def test_a_source_that_learns_from_all_frames_refuses(labelgen, clip: Path, tmp_path: Path) -> None:
    done = labelgen("bcs-masks", clip, "--masks", "background", "--keyframes", "--out", "out")
    assert done.returncode == 2
    assert "--keyframes: masks background learn from all frames" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "out" / "dataset.json").exists()


@pytest.mark.slow
def test_an_interrupt_comes_through_the_reading_thread(clip: Path, tmp_path: Path) -> None:
    longer = write_clip(tmp_path, 600)
    masks = json.loads((tmp_path / "masks.json").read_text())
    assert len(masks["images"]) == 600
    command = [
        sys.executable, "-m", "labelgen", "bcs-masks", longer, "--masks", f"coco:{tmp_path / 'masks.json'}",
        "--every", 1, "--per-shard", 5, "--out", tmp_path / "out",
    ]  # fmt: skip
    process = subprocess.Popen([str(word) for word in command], stderr=subprocess.PIPE, text=True)
    while not list(tmp_path.glob("out/**/*-00003.h5")):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in errors
