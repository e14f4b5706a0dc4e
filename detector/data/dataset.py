"""Shards -> augmented samples -> batches, in an order that depends on the seed and the step alone.

Sample number k of a training is the same image with the same augmentation whatever happened before: on however many
workers, and after however many interruptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from detector.data.augment import AugmentationRanges, Target, clip_to_image, jitter_color, sample_affine
from detector.model.vehicle_size import scene_vector, transform_scene
from labelgen.errors import DataError
from labelgen.geometry import Pair
from labelgen.geometry.homography import Array
from labelgen.labels import Labels, Sample
from labelgen.shards import ShardDataset, ShardReader

__all__ = [
    "Batch",
    "ShardSource",
    "StepSampler",
    "TrainingSamples",
    "ValidationSamples",
    "collate",
    "label_provenance",
    "make_loader",
    "open_sources",
    "to_tensors",
]  # fmt: skip

CROPS = "boxcars"


@dataclass(frozen=True, eq=False)
class Batch:
    """N images of one size with their labels.

    Args:
        images: (N, 3, H, W) uint8 RGB.
        targets: per image `boxes` (L, 4) float32, `labels` (L,) int64 zeros, `cc` (L,) float32, `cc_known` (L,) bool,
            `scene` (4,) float32, see `detector.model.vehicle_size.scene_vector`.
        indices: (N,) numbers of the samples.
    """

    images: Tensor
    targets: list[dict[str, Tensor]]
    indices: list[int]

    def __len__(self) -> int:
        return len(self.targets)

    def to(self, device: Any, non_blocking: bool = False) -> Batch:
        """The batch on a device."""
        move = [{key: value.to(device, non_blocking=non_blocking) for key, value in t.items()} for t in self.targets]
        return Batch(self.images.to(device, non_blocking=non_blocking), move, self.indices)

    def pin_memory(self) -> Batch:
        """For faster transfer to a GPU."""
        return Batch(self.images.pin_memory(), self.targets, self.indices)


@dataclass(frozen=True, eq=False)
class ShardSource:
    """One set of shards that is drawn from with a weight.

    Args:
        shards: the samples.
        weight: share of the drawn samples, relative to the other sources'.
        crops: whether they are crops of single vehicles, to be put on black, rather than whole pictures.
    """

    shards: ShardDataset[Sample]
    weight: float
    crops: bool


def open_sources(
    paths: Sequence[str | Path], pair: Pair | None = None, size_wh: tuple[int, int] | None = None
) -> list[ShardSource]:
    """Shard files and folders as sources; PATH:WEIGHT gives a weight, else it is the number of samples.

    Args:
        paths: shards, or folders of them.
        pair: that all must have; whatever the first has by default.
        size_wh: that whole pictures must have, likewise; crops may have any.

    Raises:
        DataError: none there, or of another pair or size than wanted.
    """
    sources = []
    for text in map(str, paths):
        place, _, number = text.rpartition(":")
        weight = _weight(number) if place and not Path(text).exists() else None
        shards = ShardDataset([text if weight is None else place])
        crops = [reader.settings.get("kind") == CROPS for reader in shards.readers]
        if len(set(crops)) > 1:
            raise DataError(f"{text}: it holds both crops and whole pictures; name their folders one by one")
        for reader in shards.readers:
            pair = pair or reader.pair
            wrong_size = not crops[0] and size_wh is not None and reader.size_wh != size_wh
            if reader.pair is not pair or wrong_size:
                wanted = "" if crops[0] or size_wh is None else " {}x{}".format(*size_wh)
                raise DataError(
                    f"{reader.path}: its pictures are {reader.pair} {'{}x{}'.format(*reader.size_wh)}, but "
                    f"{pair}{wanted} is wanted; choose the preset made for them, or make shards of that pair and size"
                )
            size_wh = size_wh or (None if crops[0] else reader.size_wh)
        if len(shards):
            sources.append(ShardSource(shards, float(len(shards)) if weight is None else weight, crops[0]))
    if not sources or not sum(source.weight for source in sources) > 0:
        raise DataError(f"{', '.join(map(str, paths))}: no samples to draw from")
    return sources


def _weight(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if value >= 0 and np.isfinite(value) else None


def label_provenance(sources: Sequence[ShardSource]) -> list[dict[str, Any]]:
    """What the labels are and where they come from, as plain values for a checkpoint."""
    found = []
    for source in sources:
        readers = source.shards.readers
        found.append(
            {
                "samples": len(source.shards),
                "weight": source.weight,
                "producers": sorted({str(reader.attributes["producer"]) for reader in readers}),
                "settings": [dict(t) for t in {tuple(sorted(_plain(r.settings).items())) for r in readers}],
                "sha256": [str(reader.attributes["content_sha256"]) for reader in readers],
            }
        )
    return found


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value if isinstance(value, int | float | str | bool | None) else str(value)
        for key, value in settings.items()
    }


def to_tensors(image: NDArray[np.uint8], target: Target, scene: Array) -> tuple[Tensor, dict[str, Tensor]]:
    """Image (H, W, 3) BGR, labels and scene (4,) as a model's input and target."""
    rgb = np.ascontiguousarray(image[:, :, ::-1].transpose(2, 0, 1))
    return torch.from_numpy(rgb), {
        "boxes": torch.from_numpy(target.boxes_xyxy.astype(np.float32)).reshape(-1, 4),
        "labels": torch.zeros(len(target.cc), dtype=torch.int64),
        "cc": torch.from_numpy(target.cc.astype(np.float32)),
        "cc_known": torch.from_numpy(target.cc_known),
        "scene": torch.from_numpy(scene.astype(np.float32)),
    }


class TrainingSamples(Dataset[tuple[Tensor, dict[str, Tensor], int]]):
    """The endless sequence of augmented samples of a training.

    In every pass over as many samples as the sources hold together, each source gets its share, each of its samples in
    turn, in an order drawn for the pass.

    Args:
        sources: what to draw from.
        size_wh: of the pictures.
        whole, crops: augmentation of whole pictures and of crops.
        seed: decides everything.
    """

    def __init__(
        self,
        sources: Sequence[ShardSource],
        size_wh: tuple[int, int],
        whole: AugmentationRanges,
        crops: AugmentationRanges,
        seed: int,
    ) -> None:
        self._sources, self._size_wh, self._seed = list(sources), size_wh, seed
        self._whole, self._crops = whole, crops
        self._pass_length = sum(len(source.shards) for source in sources)
        weights = np.array([source.weight for source in sources])
        ends = np.round(np.cumsum(weights / weights.sum()) * self._pass_length).astype(np.int64)
        self._shares = np.diff(ends, prepend=0)
        self._scenes: dict[Path, Array] = {}
        self._plan = lru_cache(maxsize=2)(self._draw_plan)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_plan"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._plan = lru_cache(maxsize=2)(self._draw_plan)

    def _draw_plan(self, number: int) -> NDArray[np.int64]:
        """(pass length, 2) source and sample of every place in a pass."""
        rows = []
        for s, (source, share) in enumerate(zip(self._sources, self._shares.tolist(), strict=True)):
            size = len(source.shards)
            turns = np.arange(number * share, (number + 1) * share)
            orders = {
                int(turn): np.random.default_rng([self._seed, 1, s, int(turn)]).permutation(size)
                for turn in np.unique(turns // size)
            }
            chosen = [orders[t // size][t % size] for t in turns.tolist()]
            rows.append(np.stack([np.full(share, s), np.array(chosen, dtype=np.int64)], axis=1))
        plan = np.concatenate(rows)
        return np.asarray(np.random.default_rng([self._seed, 2, number]).permutation(plan), dtype=np.int64)

    def which(self, number: int) -> tuple[int, int]:
        """Source and sample that number k is."""
        source, index = self._plan(number // self._pass_length)[number % self._pass_length].tolist()
        return source, index

    def __getitem__(self, number: int) -> tuple[Tensor, dict[str, Tensor], int]:
        s, index = self.which(number)
        source = self._sources[s]
        # Not the whole sample: its rectification takes longer to set up than its picture to find.
        reader, row = source.shards.locate(index)
        image = _decode(reader.encoded(row), f"{reader.path}, sample {row}")
        rng = np.random.default_rng([self._seed, 3, number])
        if reader.path not in self._scenes:
            self._scenes[reader.path] = _scenes(reader)
        scene = self._scenes[reader.path][row]
        return (*to_tensors(*self.augment(image, reader.labels(row), scene, source.crops, rng)), number)

    def augment(
        self, image: NDArray[np.uint8], labels: Labels, scene: Array, crops: bool, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], Target, Array]:
        """A picture (H, W, 3) BGR, its labels and scene (4,) as they go into training."""
        ranges = self._crops if crops else self._whole
        move = sample_affine(rng, ranges, (image.shape[1], image.shape[0]), self._size_wh, fill=crops)
        target = Target.of(labels)
        moved = clip_to_image(Target(move.boxes(target.boxes_xyxy), target.cc, target.cc_known), self._size_wh)
        out = move.image(image, self._size_wh)
        scene = transform_scene(scene, move.scale_xy[1], move.shift_xy[1])
        return jitter_color(rng, out, ranges.light) if ranges.light else out, moved, scene


def _scenes(reader: ShardReader) -> Array:
    """(N, 4) `scene_vector` of all samples of a shard: few kinds, and one takes a share of a small picture's time."""
    names = ("samples/matrix", "samples/vpu", "samples/camera")
    rows = np.concatenate([reader.table(name).reshape(len(reader), -1) for name in names], axis=1)
    kinds, of = np.unique(rows, axis=0, return_inverse=True)
    found = [scene_vector(k[:9].reshape(3, 3), k[9:11], reader.pair, reader.cameras[int(k[11])]) for k in kinds]
    return np.array(found).reshape(-1, 4)[of.ravel()]


def _decode(encoded: bytes, where: str) -> NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_COLOR) if encoded else None
    if image is None:
        raise DataError(f"{where}: its image cannot be decoded; make the shard again")
    return np.asarray(image, dtype=np.uint8)


class ValidationSamples(Dataset[tuple[Tensor, dict[str, Tensor], int]]):
    """All samples of shards as they are, in order.

    Args:
        shards: the samples.
    """

    def __init__(self, shards: ShardDataset[Sample]) -> None:
        self.shards = shards

    def __len__(self) -> int:
        return len(self.shards)

    def __getitem__(self, index: int) -> tuple[Tensor, dict[str, Tensor], int]:
        sample = self.shards[index]
        rectification = sample.rectification
        scene = scene_vector(rectification.matrix, rectification.vpu, rectification.pair, sample.camera)
        return (*to_tensors(sample.image, Target.of(sample.labels), scene), index)


def collate(items: Sequence[tuple[Tensor, dict[str, Tensor], int]]) -> Batch:
    """Samples of one size -> a batch."""
    images, targets, indices = zip(*items, strict=True)
    return Batch(torch.stack(images), list(targets), list(indices))


class StepSampler(Sampler[list[int]]):
    """Numbers of the samples of each remaining batch of an epoch.

    Args:
        batch: samples per step and process.
        steps: per epoch.
        step_now: tells the number of steps done so far, in all epochs together.
        place: tells the number of this process and how many there are; asked late, when launchers have settled it.
    """

    def __init__(
        self,
        batch: int,
        steps: int,
        step_now: Callable[[], int],
        place: Callable[[], tuple[int, int]] = lambda: (0, 1),
    ) -> None:
        self._batch, self._steps, self._step_now, self._place = batch, steps, step_now, place

    def __len__(self) -> int:
        return self._steps

    def __iter__(self) -> Iterator[list[int]]:
        first, (rank, world) = self._step_now(), self._place()
        # After a resumption in the middle of an epoch only the rest of it is left.
        for step in range(first, (first // self._steps + 1) * self._steps):
            start = (step * world + rank) * self._batch
            yield list(range(start, start + self._batch))


def make_loader(
    samples: Dataset[Any], *, batches: Sampler[list[int]] | None = None, batch: int = 8, workers: int = 0
) -> DataLoader[Batch]:
    """A loader of batches: those of a sampler, or all samples in order.

    Args:
        samples: the data set.
        batches: numbers of the samples of each batch.
        batch: samples in a batch, without `batches`.
        workers: processes; 0 for none beside this one. Any number gives the same batches.
    """
    more: dict[str, Any] = {"batch_size": batch} if batches is None else {"batch_sampler": batches}
    if workers:
        more |= {"persistent_workers": True, "prefetch_factor": 4, "multiprocessing_context": "fork"}
    return DataLoader(
        samples, num_workers=workers, collate_fn=collate, pin_memory=torch.cuda.is_available(),
        worker_init_fn=_one_thread, **more,
    )  # fmt: skip


def _one_thread(_: int) -> None:
    cv2.setNumThreads(0)
