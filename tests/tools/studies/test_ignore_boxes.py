"""Masks like a network's, and what becomes of the vehicles that they show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycocotools import mask as coco_mask

from labelgen.atomic_files import write_json
from labelgen.labels import IgnoredBoxes
from labelgen.shards import ShardDataset
from labelgen.synth.truth.session import write_session
from tools.studies.ignore_boxes import count_vehicles, degrade_mask, degrade_session


def _disc(radius: int) -> np.ndarray:
    y, x = np.mgrid[:120, :160]
    return np.hypot(x - 80, y - 60) < radius


def test_degraded_masks_are_near_the_exact_ones_and_seeded() -> None:
    exact = _disc(30)
    shares = []
    for seed in range(60):
        mask = degrade_mask(exact, np.random.default_rng(seed))
        np.testing.assert_array_equal(mask, degrade_mask(exact, np.random.default_rng(seed)))
        shares.append(np.count_nonzero(mask & exact) / np.count_nonzero(mask | exact))
    assert 0.85 < np.median(shares) < 0.99  # a network's masks
    assert min(shares) < 0.75  # some lack a part


@pytest.mark.slow
def test_every_vehicle_that_a_mask_shows_has_a_label_or_is_ignored(labelgen, tmp_path: Path) -> None:
    write_session(tmp_path, duration_s=12, fps=1, size_wh=(640, 360), seed=4, name="made", per_minute=40)
    session = tmp_path / "dataset" / "made"
    masks = degrade_session(session)
    assert masks == degrade_session(session)
    assert masks != degrade_session(session, seed=1)
    assert all(coco_mask.area(annotation["segmentation"]) > 0 for annotation in masks["annotations"])
    write_json(tmp_path / "masks.json", masks)
    options = ["--masks", "coco:masks.json", "--rule", "wider", "--every", 1, "--size", "480x270", "--out", "shards"]
    done = labelgen("bcs-masks", session, *options)
    assert done.returncode == 0, done.stderr
    samples = list(ShardDataset(tmp_path / "shards"))
    counts, lines = count_vehicles(samples, session, masks)
    assert counts["label"] > 10
    assert counts["ignored"] > 0
    assert counts["neither"] == 0, lines
    bare = [replace(sample, ignored=IgnoredBoxes.empty()) for sample in samples]
    without, lines = count_vehicles(bare, session, masks)
    assert without["ignored"] == 0
    assert without["label"] == counts["label"]
    assert without["neither"] + without["poor label"] + without["no mask"] > 0
    assert len(lines) == without["neither"]
