"""Throughput of training data: from shards, from WebDataset tar files, and from plain files, side by side in one run.

All three give the same JPEG bytes and the same labels to the same augmentation. Shards and plain files are read in the
training's random order, WebDataset in the order of its shuffle buffer.

    python -m tools.benchmarks.loader SHARDS... [--samples 200] [--rounds 15] [--workers 0]
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from torch.utils.data import DataLoader, Dataset

from detector.data.dataset import TrainingSamples, collate, make_loader, open_sources, to_tensors
from detector.model.vehicle_size import scene_vector
from detector.training.config import find_preset
from labelgen.labels import Labels, Sample
from labelgen.shards import ShardDataset

_PER_TAR = 500
_BATCH = 8


def write_plain(shards: ShardDataset[Sample], folder: Path) -> None:
    """Write each sample as NUMBER.jpg and NUMBER.json into a folder."""
    for i in range(len(shards)):
        sample = shards[i]
        (folder / f"{i:06d}.jpg").write_bytes(sample.encoded)
        (folder / f"{i:06d}.json").write_bytes(_to_json(sample))


def write_tars(shards: ShardDataset[Sample], folder: Path) -> list[str]:
    """Write the samples as tar files of WebDataset into a folder, and return their paths."""
    paths = []
    for start in range(0, len(shards), _PER_TAR):
        path = folder / f"{start // _PER_TAR:04d}.tar"
        with tarfile.open(path, "w") as tar:
            for i in range(start, min(start + _PER_TAR, len(shards))):
                sample = shards[i]
                for suffix, data in (("jpg", sample.encoded), ("json", _to_json(sample))):
                    info = tarfile.TarInfo(f"{i:06d}.{suffix}")
                    info.size = len(data)
                    tar.addfile(info, io.BytesIO(data))
        paths.append(str(path))
    return paths


def _to_json(sample: Sample) -> bytes:
    labels, view = sample.labels, sample.rectification
    row = {
        "boxes": labels.boxes_xyxy.tolist(), "cc": labels.cc.tolist(), "flags": labels.flags.tolist(),
        "scene": scene_vector(view.matrix, view.vpu, view.pair, sample.camera).tolist(),
    }  # fmt: skip
    return json.dumps(row).encode()


class _PlainSamples(Dataset[Any]):
    """The training's samples, read from plain files."""

    def __init__(self, samples: TrainingSamples, folder: Path) -> None:
        self._samples, self._folder = samples, folder

    def __getitem__(self, number: int) -> Any:
        _, index = self._samples.locate(number)
        data = [(self._folder / f"{index:06d}.{suffix}").read_bytes() for suffix in ("jpg", "json")]
        return _finish(self._samples, data[0], data[1], number)


def _finish(samples: TrainingSamples, encoded: bytes, labels: bytes, number: int) -> Any:
    row = json.loads(labels)
    read = Labels(np.array(row["boxes"]).reshape(-1, 4), np.array(row["cc"]), flags=np.array(row["flags"]))
    image = np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    rng = np.random.default_rng([0, 3, number])
    return (*to_tensors(*samples.augment(image, read, np.array(row["scene"]), False, rng)), number)


def _drain(batches: Iterator[Any], samples: int) -> tuple[float, float]:
    """Return the samples per second over the next samples, by wall-clock time and by processor time of this process."""
    count, wall_start, processor_start = 0, time.perf_counter(), time.process_time()
    while count < samples:
        count += len(next(batches))
    return count / (time.perf_counter() - wall_start), count / (time.process_time() - processor_start)


def _forever(make: Callable[[], Any]) -> Iterator[Any]:
    while True:
        yield from make()


class _Numbers:
    """Batches of the numbers 0, 1, 2, ..."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[list[int]]:
        return (list(range(i * _BATCH, (i + 1) * _BATCH)) for i in range(self._count))


def benchmark(paths: Sequence[Path], samples: int, rounds: int, workers: int) -> dict[str, Any]:
    """Measure the three loaders in alternating rounds.

    Without loader processes the ratios are of processor time, which other work on the machine disturbs less.

    Args:
        paths: shards.
        samples: samples of each loader and round.
        rounds: number of rounds.
        workers: loader processes.

    Returns:
        Samples per second of each round, their medians, and the median ratio of shards to each of the others.
    """
    import webdataset

    sources = open_sources(paths)
    shards = ShardDataset(paths)
    size_wh = shards.readers[0].size_wh
    preset = find_preset("small")
    training = TrainingSamples(sources, size_wh, preset.whole, preset.crops, 0)
    numbers: Any = _Numbers(rounds * (samples // _BATCH + 2) + 8 * workers)
    with tempfile.TemporaryDirectory() as place:
        plain, tars = Path(place) / "plain", Path(place) / "tars"
        plain.mkdir()
        tars.mkdir()
        write_plain(shards, plain)
        urls = write_tars(shards, tars)

        def unpack(item: dict[str, Any]) -> Any:
            return _finish(training, item["jpg"], item["json"], int(item["__key__"]))

        web = webdataset.WebDataset(urls, shardshuffle=100, seed=0, empty_check=False).shuffle(1000).map(unpack)
        loaders = {
            "shards": iter(make_loader(training, batches=numbers, workers=workers)),
            "webdataset": _forever(lambda: DataLoader(web, batch_size=_BATCH, collate_fn=collate, num_workers=workers)),
            "plain files": iter(make_loader(_PlainSamples(training, plain), batches=numbers, workers=workers)),
        }
        rates: dict[str, list[tuple[float, float]]] = {name: [] for name in loaders}
        for loader in loaders.values():
            next(loader)
        for number in range(rounds):
            # Each round in another order, so that none always runs on what another left in the caches.
            for name in sorted(loaders, key=lambda key: (list(loaders).index(key) + number) % 3):
                rates[name].append(_drain(loaders[name], samples))
    by = 0 if workers else 1
    ratios = {
        name: statistics.median(ours[by] / other[by] for ours, other in zip(rates["shards"], values, strict=True))
        for name, values in rates.items()
    }
    rounds_by_clock = {name: [clock for clock, _ in values] for name, values in rates.items()}
    return {
        "pictures": len(shards), "samples": samples, "workers": workers, "rounds": rounds_by_clock,
        "median": {name: statistics.median(values) for name, values in rounds_by_clock.items()},
        "shards_over": {name: ratio for name, ratio in ratios.items() if name != "shards"},
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shards", nargs="+", type=Path)
    parser.add_argument("--samples", type=int, default=200, help="of each, per round")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    result = benchmark(given.shards, given.samples, given.rounds, given.workers)
    for name, rate in result["median"].items():
        print(f"{name:12} {rate:8.1f} samples/s  ({', '.join(f'{v:.0f}' for v in result['rounds'][name])})")
    for name, ratio in result["shards_over"].items():
        print(f"shards / {name}: {ratio:.3f}")
    if given.json is not None:
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
