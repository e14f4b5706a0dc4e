"""Shards -> augmented samples -> batches, in an order that depends on the seed and the step alone.

Sample number k of a training run is the same image with the same augmentation for any number of loader processes, and
after any number of interruptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from detector.data.augment import AugmentationRanges, TrainingTarget, clip_to_image, jitter_color, sample_affine
from detector.model.vehicle_size import scene_vector, transform_scene
from labelgen.errors import DataError
from labelgen.geometry import Pair
from labelgen.geometry.homography import Array
from labelgen.labels import IgnoredBoxes, Labels, Sample
from labelgen.media.image_file import decode_image
from labelgen.shards import ShardDataset, ShardReader
from labelgen.shards.dataset import check_finished

__all__ = [
    "Batch",
    "ShardSource",
    "StepSampler",
    "TrainingSamples",
    "ValidationSamples",
    "collate",
    "label_provenance",
    "make_loader",
    "open_shards",
    "open_sources",
    "to_tensors",
]  # fmt: skip

_CROPS_KIND = "boxcars"
"""The `kind` in the settings of shards whose pictures are crops of single vehicles."""


@dataclass(frozen=True, eq=False)
class Batch:
    """N images of one size with their labels.

    Args:
        images: (N, 3, H, W) uint8 RGB.
        targets: per image `boxes` (L, 4) float32 px, `labels` (L,) int64 zeros, `cc` (L,) float32, `cc_known` (L,)
            bool, `ignored` (K, 4) float32 px, `scene` (4,) float32, see `detector.model.vehicle_size.scene_vector`.
        indices: (N,) numbers of the samples.
    """

    images: Tensor
    targets: list[dict[str, Tensor]]
    indices: list[int]

    def __len__(self) -> int:
        return len(self.targets)

    def to(self, device: Any, non_blocking: bool = False) -> Batch:
        """Return the batch on a device."""
        targets = [{key: value.to(device, non_blocking=non_blocking) for key, value in t.items()} for t in self.targets]
        return Batch(self.images.to(device, non_blocking=non_blocking), targets, self.indices)

    def pin_memory(self) -> Batch:
        """Return the batch in pinned memory, from which the transfer to a GPU is faster."""
        return Batch(self.images.pin_memory(), self.targets, self.indices)


@dataclass(frozen=True, eq=False)
class ShardSource:
    """One set of shards and how often samples are drawn from it.

    Args:
        shards: the samples.
        weight: share of the drawn samples, relative to the other sources'.
        crops: whether the pictures are crops of single vehicles, to be placed on black, rather than whole pictures.
    """

    shards: ShardDataset[Sample]
    weight: float
    crops: bool


def open_sources(
    paths: Sequence[str | Path], pair: Pair | None = None, size_wh: tuple[int, int] | None = None
) -> list[ShardSource]:
    """Open shard files and folders for training.

    Args:
        paths: shards or folders of them; PATH:WEIGHT gives a weight, which is the number of samples by default.
        pair: that all must have; None for that of the first.
        size_wh: width, height px that whole pictures must have; None for those of the first. Crops may have any size.

    Returns:
        one source per path that has samples.

    Raises:
        DataError: no samples, shards of another pair or size, or a folder whose data set is not finished.
    """
    sources = []
    for text in map(str, paths):
        place, _, number = text.rpartition(":")
        weight = _weight(number) if place and not Path(text).exists() else None
        shards = ShardDataset([text if weight is None else place])
        check_finished(Path(text if weight is None else place), shards.readers)
        crops = [reader.settings.get("kind") == _CROPS_KIND for reader in shards.readers]
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


def open_shards(paths: Sequence[str | Path], pair: Pair, size_wh: tuple[int, int]) -> ShardDataset[Sample]:
    """Open shard files and folders to run a detector on their pictures.

    Args:
        paths: shards or folders of them.
        pair: that all must have.
        size_wh: width, height px that whole pictures must have.

    Raises:
        DataError: no samples, or shards of another pair or size.
    """
    open_sources(paths, pair, size_wh)
    return ShardDataset(paths)


def _weight(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if value >= 0 and np.isfinite(value) else None


def label_provenance(sources: Sequence[ShardSource]) -> list[dict[str, Any]]:
    """Describe where labels come from, as plain values for a checkpoint.

    Returns:
        one dict per source, with its number of samples, weight, and the producers, settings and checksums of its
        shards. Its keys are part of the checkpoint format.
    """
    provenance = []
    for source in sources:
        readers = source.shards.readers
        provenance.append(
            {
                "samples": len(source.shards),
                "weight": source.weight,
                "producers": sorted({str(reader.attributes["producer"]) for reader in readers}),
                "settings": [dict(t) for t in {tuple(sorted(_plain(r.settings).items())) for r in readers}],
                "sha256": [str(reader.attributes["content_sha256"]) for reader in readers],
            }
        )
    return provenance


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value if isinstance(value, int | float | str | bool | None) else str(value)
        for key, value in settings.items()
    }


def to_tensors(image: NDArray[np.uint8], target: TrainingTarget, scene: Array) -> tuple[Tensor, dict[str, Tensor]]:
    """Convert a picture and what is learnt from it to tensors.

    Args:
        image: (H, W, 3) uint8 BGR.
        target: boxes and c_c.
        scene: (4,) of `detector.model.vehicle_size.scene_vector`.

    Returns:
        image (3, H, W) uint8 RGB, and one of the targets of a `Batch`.
    """
    rgb = np.ascontiguousarray(image[:, :, ::-1].transpose(2, 0, 1))
    return torch.from_numpy(rgb), {
        "boxes": torch.from_numpy(target.boxes_xyxy.astype(np.float32)).reshape(-1, 4),
        "labels": torch.zeros(len(target.cc), dtype=torch.int64),
        "cc": torch.from_numpy(target.cc.astype(np.float32)),
        "cc_known": torch.from_numpy(target.cc_known),
        "ignored": torch.from_numpy(target.ignored_xyxy.astype(np.float32)).reshape(-1, 4),
        "scene": torch.from_numpy(scene.astype(np.float32)),
    }


class TrainingSamples(Dataset[tuple[Tensor, dict[str, Tensor], int]]):
    """The endless sequence of augmented samples of a training run.

    A pass has as many samples as all sources together. In each pass a source gets its share, and goes through its
    samples in turn, in an order drawn for the pass.

    Args:
        sources: shards with their weights.
        size_wh: width, height px of the pictures.
        whole: augmentation of whole pictures.
        crops: augmentation of crops.
        seed: of order and augmentation.
        ignore_boxes: whether the shards' ignored boxes, and labels that the border cuts off, are left out of the loss;
            else they are background.
        max_sigma: labels whose stated standard deviation of c_c is larger are ignored; None to keep all.
    """

    def __init__(
        self,
        sources: Sequence[ShardSource],
        size_wh: tuple[int, int],
        whole: AugmentationRanges,
        crops: AugmentationRanges,
        seed: int,
        *,
        ignore_boxes: bool = True,
        max_sigma: float | None = None,
    ) -> None:
        self._sources, self._size_wh, self._seed = list(sources), size_wh, seed
        self._whole, self._crops, self._ignore_boxes, self._max_sigma = whole, crops, ignore_boxes, max_sigma
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
        """Draw the source and sample, (pass length, 2), of every position in a pass."""
        rows = []
        for s, (source, share) in enumerate(zip(self._sources, self._shares.tolist(), strict=True)):
            size = len(source.shards)
            turns = np.arange(number * share, (number + 1) * share)
            orders = {
                int(turn): np.random.default_rng([self._seed, 1, s, int(turn)]).permutation(size)
                for turn in np.unique(turns // size)
            }
            indices = [orders[t // size][t % size] for t in turns.tolist()]
            rows.append(np.stack([np.full(share, s), np.array(indices, dtype=np.int64)], axis=1))
        plan = np.concatenate(rows)
        return np.asarray(np.random.default_rng([self._seed, 2, number]).permutation(plan), dtype=np.int64)

    def locate(self, number: int) -> tuple[int, int]:
        """Return the source and its sample that a number of the sequence stands for."""
        source, index = self._plan(number // self._pass_length)[number % self._pass_length].tolist()
        return source, index

    def __getitem__(self, number: int) -> tuple[Tensor, dict[str, Tensor], int]:
        s, index = self.locate(number)
        source = self._sources[s]
        # Not `ShardDataset[index]`: setting up its rectification takes longer than reading its picture.
        reader, row = source.shards.locate(index)
        encoded = np.frombuffer(reader.encoded(row), dtype=np.uint8)
        image = decode_image(encoded, f"{reader.path}, sample {row}", expected_wh=reader.size_wh)
        rng = np.random.default_rng([self._seed, 3, number])
        if reader.path not in self._scenes:
            self._scenes[reader.path] = _scenes(reader)
        scene = self._scenes[reader.path][row]
        parts = self.augment(image, reader.labels(row), scene, source.crops, rng, reader.ignored(row))
        return (*to_tensors(*parts), number)

    def augment(
        self,
        image: NDArray[np.uint8],
        labels: Labels,
        scene: Array,
        crops: bool,
        rng: np.random.Generator,
        ignored: IgnoredBoxes | None = None,
    ) -> tuple[NDArray[np.uint8], TrainingTarget, Array]:
        """Augment one picture with its labels.

        Args:
            image: (H, W, 3) uint8 BGR.
            labels: in the picture.
            scene: (4,) of `detector.model.vehicle_size.scene_vector`.
            crops: whether the picture is a crop of a single vehicle.
            rng: random numbers.
            ignored: boxes of vehicles without a label; None for none.

        Returns:
            picture (H, W, 3) uint8 BGR of the training's size, what is learnt from it, and its scene (4,).
        """
        ranges = self._crops if crops else self._whole
        move = sample_affine(rng, ranges, (image.shape[1], image.shape[0]), self._size_wh, fill=crops)
        target = TrainingTarget.from_labels(labels, ignored, self._max_sigma)
        moved = clip_to_image(target.moved(move), self._size_wh)
        if not self._ignore_boxes:
            moved = replace(moved, ignored_xyxy=np.empty((0, 4)))
        out = move.warp_image(image, self._size_wh)
        scene = transform_scene(scene, move.scale_xy[1], move.shift_xy[1])
        return jitter_color(rng, out, ranges.light) if ranges.light else out, moved, scene


def _scenes(reader: ShardReader) -> Array:
    """Compute `scene_vector` (N, 4) of all samples of a shard, once for those that share camera and rectification."""
    names = ("samples/matrix", "samples/vpu", "samples/camera")
    rows = np.concatenate([reader.table(name).reshape(len(reader), -1) for name in names], axis=1)
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    scenes = [scene_vector(u[:9].reshape(3, 3), u[9:11], reader.pair, reader.cameras[int(u[11])]) for u in unique]
    return np.array(scenes).reshape(-1, 4)[inverse.ravel()]


class ValidationSamples(Dataset[tuple[Tensor, dict[str, Tensor], int]]):
    """All samples of shards in order, without augmentation.

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
        target = TrainingTarget.from_labels(sample.labels, sample.ignored)
        return (*to_tensors(sample.image, target, scene), index)


def collate(items: Sequence[tuple[Tensor, dict[str, Tensor], int]]) -> Batch:
    """Join samples of one size to a batch."""
    images, targets, indices = zip(*items, strict=True)
    return Batch(torch.stack(images), list(targets), list(indices))


class StepSampler(Sampler[list[int]]):
    """Numbers of the samples of each remaining batch of an epoch.

    Args:
        batch: samples per step and process.
        steps: steps per epoch.
        current_step: returns the number of finished steps of all epochs together.
        rank_and_world_size: returns the number of this process and the number of processes; called when iteration
            starts, after the launcher has set them.
    """

    def __init__(
        self,
        batch: int,
        steps: int,
        current_step: Callable[[], int],
        rank_and_world_size: Callable[[], tuple[int, int]] = lambda: (0, 1),
    ) -> None:
        self._batch, self._steps = batch, steps
        self._current_step, self._rank_and_world_size = current_step, rank_and_world_size

    def __len__(self) -> int:
        return self._steps

    def __iter__(self) -> Iterator[list[int]]:
        first, (rank, world_size) = self._current_step(), self._rank_and_world_size()
        # Training that resumes in the middle of an epoch has only the rest of it left.
        for step in range(first, (first // self._steps + 1) * self._steps):
            start = (step * world_size + rank) * self._batch
            yield list(range(start, start + self._batch))


def make_loader(
    samples: Dataset[Any], *, batches: Sampler[list[int]] | None = None, batch: int = 8, workers: int = 0
) -> DataLoader[Batch]:
    """Make a loader of `Batch`es: those of a sampler, or all samples in order.

    Args:
        samples: the data set.
        batches: numbers of the samples of each batch; None for all samples in order.
        batch: samples in a batch, without `batches`.
        workers: loader processes; 0 to load in this process. Any number gives the same batches.
    """
    options: dict[str, Any] = {"batch_size": batch} if batches is None else {"batch_sampler": batches}
    if workers:
        options |= {"persistent_workers": True, "prefetch_factor": 4, "multiprocessing_context": "fork"}
    return DataLoader(
        samples, num_workers=workers, collate_fn=collate, pin_memory=torch.cuda.is_available(),
        worker_init_fn=_one_thread, **options,
    )  # fmt: skip


def _one_thread(_: int) -> None:
    cv2.setNumThreads(0)
