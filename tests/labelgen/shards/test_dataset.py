"""ShardDataset: one sequence over several shards, transforms, and loader workers."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from samples import write_shard

from labelgen.labels import Sample
from labelgen.shards import ShardDataset

FRAMES = [0, 250, 275, 500, 525, 550]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three shards with six samples."""
    for i in range(3):
        write_shard(tmp_path / f"shard-{i:05d}.h5", samples=i + 1, seed=10 * i)
    return tmp_path


def test_a_dataset_counts_over_files(folder: Path) -> None:
    data = ShardDataset([folder])
    assert len(data) == 6
    assert [data[i].frame for i in range(6)] == FRAMES
    assert [sample.frame for sample in data] == FRAMES
    assert data[-1].frame == 550
    assert len(data.table("labels/cc")) == sum(reader.label_count for reader in data.readers)
    with pytest.raises(IndexError):
        data[6]


def _frame_and_boxes(sample: Sample) -> tuple[int, np.ndarray]:
    return sample.frame, sample.labels.boxes_xyxy


def test_a_dataset_transforms_its_samples(folder: Path) -> None:
    data = pickle.loads(pickle.dumps(ShardDataset(str(folder), transform=_frame_and_boxes)))
    assert [frame for frame, _ in data] == FRAMES
    np.testing.assert_array_equal(data[2][1], ShardDataset(folder)[2].labels.boxes_xyxy)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_of_a_data_loader_read_a_dataset(folder: Path, method: str) -> None:
    from torch.utils.data import DataLoader

    data = ShardDataset(folder, transform=_frame_and_boxes)
    expected = list(data)  # its files are open when the workers start
    loader = DataLoader(data, batch_size=4, num_workers=2, collate_fn=list, multiprocessing_context=method)
    items = [item for batch in loader for item in batch]
    assert [frame for frame, _ in items] == FRAMES
    for (_, boxes), (_, wanted) in zip(items, expected, strict=True):
        np.testing.assert_array_equal(boxes, wanted)


def test_importing_shards_does_not_import_torch() -> None:
    code = "import sys, labelgen.shards; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
