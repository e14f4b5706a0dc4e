"""Training: shards and a preset -> a folder with checkpoints, logs and pictures.

RUN_DIR/last.ckpt        to go on from, and the newest weights
RUN_DIR/best.ckpt        best AP50 on the validation shards, where there are any
RUN_DIR/csv/             losses and validation: version_0/metrics.csv, version_1/ after a resumption, ...
RUN_DIR/pictures/        validation pictures with detections, one sheet per epoch
RUN_DIR/tensorboard/     the same figures for TensorBoard
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detector.checkpoint import METADATA_KEY, ModelMetadata, read_checkpoint
from detector.data.dataset import (
    ShardSource,
    StepSampler,
    TrainingSamples,
    ValidationSamples,
    label_provenance,
    make_loader,
    open_sources,
)
from detector.device import gains_from_half
from detector.model.anchor_fit import fit_anchors
from detector.model.retinanet import build_model
from detector.training.config import Preset, Trainer
from detector.training.pretrained import load_pretrained
from labelgen.atomic_files import make_folder
from labelgen.errors import LabelgenError, OutputError
from labelgen.geometry import Region
from labelgen.geometry.homography import Array

__all__ = ["INSTALL_HINT", "TrainSummary", "train"]

INSTALL_HINT = "training needs Lightning and TensorBoard: pip install 'labelgen[train]'"
LAST, BEST = "last.ckpt", "best.ckpt"


@dataclass(frozen=True)
class TrainSummary:
    """How a training ended.

    Args:
        steps, epochs: done in all, resumed ones included.
        checkpoint: the newest.
        best: with the best validation, or None.
        metrics: the last figures.
        interrupted: whether somebody stopped it.
    """

    steps: int
    epochs: int
    checkpoint: Path
    best: Path | None
    metrics: dict[str, float]
    interrupted: bool


def train(
    shards: Sequence[str | Path],
    preset: Preset,
    out: Path,
    *,
    validation: Sequence[str | Path] = (),
    weights: Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    seed: int = 0,
    machine: Trainer | None = None,
) -> TrainSummary:
    """Train a detector.

    Args:
        shards: files, folders, or FOLDER:WEIGHT.
        preset: what and how; pair and size are those of the shards where it leaves them open.
        out: run folder.
        validation: shards to judge by after every epoch.
        weights: what to begin with, see `detector.training.pretrained`.
        resume: go on from the folder's last checkpoint.
        overwrite: begin anew in a folder that has one.
        seed: of weights, order and augmentation.
        machine: devices and so on.

    Raises:
        DataError: shards of another pair or size, or weights that do not fit.
        OutputError: the folder has a checkpoint and neither `resume` nor `overwrite` is given.
        LabelgenError: Lightning is not installed, or the shards lack labels.
    """
    machine = machine or Trainer()
    sources = open_sources(shards, preset.pair, preset.size_wh)
    metadata, steps = _plan(preset, sources, seed)
    judged = _open_validation(validation, metadata)
    last = out / LAST
    if resume:
        metadata = _same_card(read_checkpoint(last).get(METADATA_KEY), metadata, last)
    elif last.exists() and not overwrite:
        raise OutputError(f"{out}: it holds a training; go on with --resume, or begin anew with --overwrite")
    make_folder(out)
    torch.manual_seed(seed)
    model = build_model(metadata.config, weights="none" if weights or resume else preset.weights)
    if weights is not None and not resume:
        load_pretrained(model, read_checkpoint(weights), f"--weights {weights}")
    samples = TrainingSamples(sources, metadata.size_wh, preset.whole, preset.crops, seed)
    return _fit(model, preset, metadata, samples, judged, steps, out, last if resume else None, machine)


def _plan(preset: Preset, sources: Sequence[ShardSource], seed: int) -> tuple[ModelMetadata, int]:
    """The checkpoint's metadata, and the number of steps in an epoch."""
    readers = [reader for source in sources for reader in source.shards.readers]
    pair = preset.pair or readers[0].pair
    pictures = [reader.size_wh for source in sources if not source.crops for reader in source.shards.readers]
    size_wh = preset.size_wh or (pictures[0] if pictures else (2 * readers[0].size_wh[0], 2 * readers[0].size_wh[1]))
    config = preset.model
    if preset.fit_anchors is not None:
        boxes = np.concatenate([_boxes(source, preset, size_wh) for source in sources])
        if not len(boxes):
            raise LabelgenError(f"{readers[0].path}: no labels to size the anchors by")
        per_level, ratios = preset.fit_anchors
        sizes, shapes = fit_anchors(boxes, len(config.levels), per_level, ratios)
        config = replace(config, anchor_sizes=sizes, anchor_ratios=shapes)
    steps = preset.steps_per_epoch or max(1, sum(len(source.shards) for source in sources) // preset.batch)
    heights = [float(reader.settings.get("min_height_px", 0) or 0) for reader in readers]
    training = {
        "seed": seed, "batch": preset.batch, "epochs": preset.epochs, "steps_per_epoch": steps,
        "optimiser": preset.optimiser, "lr": preset.lr, "clip_norm": preset.clip_norm, "schedule": preset.schedule,
        "whole": asdict(preset.whole), "crops": asdict(preset.crops),
    }  # fmt: skip
    metadata = ModelMetadata(preset.name, pair, size_wh, config, max(heights), label_provenance(sources), training)
    if metadata.region is Region.NONE and config.cc_weight:
        raise LabelgenError(
            f"{readers[0].path}: its pictures are not rectified, so there is no c_c; use --preset orig2d"
        )
    return metadata, steps


def _boxes(source: ShardSource, preset: Preset, size_wh: tuple[int, int]) -> Array:
    """Boxes (N, 4) of a source at both ends of the middle half of augmentation's scales."""
    boxes: Array = source.shards.table("labels/box").astype(np.float64)
    ranges = preset.crops if source.crops else preset.whole
    base = np.divide(size_wh, source.shards.readers[0].size_wh) if source.crops else np.ones(2)
    ends = np.quantile(ranges.scale, [0.25, 0.75])
    return np.concatenate([boxes * np.tile(base, 2) * end for end in ends])


def _open_validation(paths: Sequence[str | Path], metadata: ModelMetadata) -> ValidationSamples | None:
    if not paths:
        return None
    from labelgen.shards import ShardDataset

    open_sources(paths, metadata.pair, metadata.size_wh)  # refuses what does not fit
    return ValidationSamples(ShardDataset(paths))


def _same_card(stored: Any, metadata: ModelMetadata, path: Path) -> ModelMetadata:
    """The stored metadata, if training goes on under the same settings."""
    before = ModelMetadata.from_dict(stored, f"checkpoint {path}")
    pairs = {
        "preset": (before.preset, metadata.preset),
        "pair and size": ((before.pair, before.size_wh), (metadata.pair, metadata.size_wh)),
        "shards": (before.labels, metadata.labels),
        **{key: (before.training.get(key), value) for key, value in metadata.to_dict()["training"].items()},
    }
    changed = [name for name, (old, new) in pairs.items() if _plain(old) != _plain(new)]
    if changed:
        raise LabelgenError(
            f"--resume {path}: {', '.join(changed)} differ from those it was begun with; give the same, or start a "
            "new run with --weights"
        )
    return before


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return {k: _plain(v) for k, v in value.items()} if isinstance(value, dict) else value


def _precision(preset: Preset, machine: Trainer) -> Any:
    """Lightning's name for the precision that suits the device."""
    on_cpu = machine.accelerator == "cpu" or not torch.cuda.is_available()
    device = torch.device("cpu" if on_cpu else "cuda")
    return "bf16-mixed" if preset.half and gains_from_half(device) else "32-true"


def _fit(
    model: Any, preset: Preset, metadata: ModelMetadata, samples: TrainingSamples, judged: ValidationSamples | None,
    steps: int, out: Path, resume_from: Path | None, machine: Trainer,
) -> TrainSummary:  # fmt: skip
    try:
        import lightning.pytorch as pl

        from detector.training.callbacks import callbacks, loggers
        from detector.training.lightning_module import DetectorModule
    except ModuleNotFoundError as err:
        raise LabelgenError(f"{err.name} is not installed; {INSTALL_HINT}") from None

    module = DetectorModule(model, preset, metadata, preset.epochs * steps, judged)
    trainer = pl.Trainer(
        accelerator=machine.accelerator, devices=machine.devices, num_nodes=machine.num_nodes,
        strategy=machine.strategy, precision=machine.precision or _precision(preset, machine), max_epochs=preset.epochs,
        gradient_clip_val=preset.clip_norm, logger=loggers(out), use_distributed_sampler=False,
        callbacks=callbacks(out, preset, judged is not None, machine), num_sanity_val_steps=0,
        enable_progress_bar=machine.progress, enable_model_summary=False, log_every_n_steps=10,
        default_root_dir=out,
    )  # fmt: skip
    batches = StepSampler(
        preset.batch, steps, lambda: trainer.global_step, lambda: (trainer.global_rank, trainer.world_size)
    )
    loaders = [make_loader(samples, batches=batches, workers=machine.workers)]
    if judged is not None:
        loaders.append(make_loader(judged, batch=preset.batch, workers=machine.workers))
    trainer.fit(
        module, loaders[0], loaders[1] if judged is not None else None, ckpt_path=resume_from, weights_only=True
    )
    best = out / BEST
    metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    return TrainSummary(
        trainer.global_step, trainer.current_epoch, out / LAST, best if best.exists() else None, metrics,
        trainer.interrupted,
    )  # fmt: skip
