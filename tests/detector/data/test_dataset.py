"""The order of the data, its mixture, and what is refused."""

from __future__ import annotations

import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from detector_shards import painted_sample, write_painted_shards

from detector.data.augment import AugmentationRanges
from detector.data.dataset import (
    StepSampler,
    TrainingSamples,
    ValidationSamples,
    label_provenance,
    make_loader,
    open_sources,
)
from labelgen.errors import DataError
from labelgen.geometry import Pair
from labelgen.labels import IgnoredBoxes
from labelgen.shards import ShardDataset, ShardWriter

SIZE = (160, 96)
WHOLE = AugmentationRanges(0.2, (0.8, 1.4), 1.2, 0.5, 0.2)
CROPS = AugmentationRanges(0.4, (0.2, 0.6), 1.0, 0.5)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("shards")
    return {
        "a": write_painted_shards(root / "a", 6, seed=1),
        "b": write_painted_shards(root / "b", 4, seed=2),
        "crops": write_painted_shards(root / "crops", 5, seed=3, size_wh=(80, 48), kind="boxcars"),
        "small": write_painted_shards(root / "small", 2, seed=4, size_wh=(128, 96)),
        "other": write_painted_shards(root / "other", 2, seed=5, size_wh=(96, 160), pair=Pair.VP1_VP2),
    }


def samples(paths: list[str | Path], seed: int = 0) -> TrainingSamples:
    return TrainingSamples(open_sources(paths), SIZE, WHOLE, CROPS, seed)


def steps(loader: torch.utils.data.DataLoader, count: int) -> list[tuple[bytes, bytes]]:
    out = []
    for batch in loader:
        labels = torch.cat([t["boxes"] for t in batch.targets]).numpy().tobytes()
        out.append((batch.images.numpy().tobytes(), labels))
        if len(out) == count:
            break
    return out


def test_batches_do_not_depend_on_the_number_of_workers(folders: dict[str, Path]) -> None:
    runs = []
    for workers in (0, 2):
        loader = make_loader(
            samples([folders["a"], folders["b"]], 7), batches=StepSampler(3, 4, lambda: 0), workers=workers
        )
        runs.append(steps(loader, 4))
    assert len(runs[0]) == 4
    assert runs[0] == runs[1]


def test_a_later_step_is_the_same_without_the_earlier_ones(folders: dict[str, Path]) -> None:
    all_of_it: list[tuple[bytes, bytes]] = []
    loader = make_loader(samples([folders["a"]]), batches=StepSampler(2, 4, lambda: len(all_of_it)))
    for _ in range(3):
        all_of_it += steps(loader, 99)
    resumed = steps(make_loader(samples([folders["a"]]), batches=StepSampler(2, 4, lambda: 6)), 99)
    assert len(all_of_it) == 12
    assert resumed == all_of_it[6:8]


def test_ignored_boxes_reach_the_batch_unless_they_are_not_wanted(tmp_path: Path) -> None:
    """A box to ignore in the place of a label is moved as that label is."""
    folder = tmp_path / "ignored"
    folder.mkdir()
    with ShardWriter(folder / "shard-00000.h5", Pair.VP2_VP3, SIZE, source="painted") as writer:
        for seed in (1, 2, 3, 6):
            sample = painted_sample(seed)
            writer.add(replace(sample, ignored=IgnoredBoxes(sample.labels.boxes_xyxy)))
        writer.last = True
    sources = open_sources([folder])
    with_boxes = TrainingSamples(sources, SIZE, WHOLE, CROPS, 0)
    without = TrainingSamples(sources, SIZE, WHOLE, CROPS, 0, ignore_boxes=False)
    compared = 0
    for number in range(12):
        image, target, _ = with_boxes[number]
        plain_image, plain, _ = without[number]
        assert torch.equal(image, plain_image)
        assert torch.equal(target["boxes"], plain["boxes"])
        assert plain["ignored"].shape == (0, 4)
        ignored = target["ignored"].tolist()
        assert all(box in ignored for box in target["boxes"].tolist())
        compared += len(target["boxes"])
    assert compared > 5


def test_seeds_differ(folders: dict[str, Path]) -> None:
    runs = [
        steps(make_loader(samples([folders["a"]], seed), batches=StepSampler(2, 2, lambda: 0)), 2) for seed in (0, 1)
    ]
    assert runs[0] != runs[1]


def test_processes_of_one_training_share_out_each_step() -> None:
    batches = [list(StepSampler(2, 3, lambda: 0, lambda rank=rank: (rank, 2))) for rank in (0, 1)]
    taken = [number for step in zip(*batches, strict=True) for batch in step for number in batch]
    assert taken == list(range(12))


def test_every_sample_comes_once_in_a_pass(folders: dict[str, Path]) -> None:
    data = samples([folders["a"], folders["b"]])
    for start in (0, 10, 20):
        assert len({data.locate(k) for k in range(start, start + 10)}) == 10
    assert [data.locate(k) for k in range(10)] != [data.locate(k) for k in range(10, 20)]


def test_weights_set_the_mixture(folders: dict[str, Path]) -> None:
    data = samples([f"{folders['a']}:3", f"{folders['crops']}:1"])
    drawn = [data.locate(k) for k in range(11 * 8)]
    shares = Counter(source for source, _ in drawn)
    assert shares[0] / len(drawn) == pytest.approx(0.75, abs=0.03)
    # Each source goes through all its samples before it repeats one.
    of_crops = [index for source, index in drawn if source == 1]
    assert max(Counter(of_crops).values()) - min(Counter(of_crops).values()) <= 1


def test_crops_are_put_on_black(folders: dict[str, Path]) -> None:
    data = samples([folders["a"], folders["crops"]])
    number = next(k for k in range(50) if data.locate(k)[0] == 1)
    image, labels, _ = data[number]
    assert image.shape == (3, SIZE[1], SIZE[0])
    assert (image == 0).float().mean() > 0.3
    assert (labels["boxes"][:, 2:] <= torch.tensor(SIZE)).all()


def test_a_data_set_travels_to_other_processes(folders: dict[str, Path]) -> None:
    data = samples([folders["a"]])
    first = data[3]
    copy = pickle.loads(pickle.dumps(data))
    assert torch.equal(copy[3][0], first[0])


def test_validation_is_unaltered_and_in_order(folders: dict[str, Path]) -> None:
    shards = ShardDataset([folders["a"]])
    batches = list(make_loader(ValidationSamples(shards), batch=4))
    assert [batch.indices for batch in batches] == [[0, 1, 2, 3], [4, 5]]
    np.testing.assert_array_equal(batches[0].images[0].permute(1, 2, 0).numpy()[:, :, ::-1], shards[0].image)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a", "small"], "pictures are VP2-VP3 128x96, but VP2-VP3 160x96 is wanted"),
        (["a", "other"], "pictures are VP1-VP2 96x160"),
        (["crops", "other"], "pictures are VP1-VP2 96x160, but VP2-VP3 is wanted"),
        (["missing"], "no such file or folder"),
    ],
)
def test_what_does_not_go_together_is_refused(folders: dict[str, Path], names: list[str], message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        open_sources([folders.get(name, Path(name)) for name in names])
    assert "\n" not in str(caught.value)


def test_provenance_is_plain(folders: dict[str, Path]) -> None:
    (row,) = label_provenance(open_sources([folders["a"]]))
    assert row["samples"] == 6
    assert row["settings"] == [{"kind": "exact"}]
    assert len(row["sha256"][0]) == 64
