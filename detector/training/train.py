"""Training: shards and a preset -> a folder with checkpoints, logs and pictures.

RUN_DIR/last.ckpt        newest weights, and all that is needed to resume
RUN_DIR/best.ckpt        weights with the best AP50 on the validation shards, where there are any
RUN_DIR/csv/             losses and validation: version_0/metrics.csv, version_1/ after a resumption, ...
RUN_DIR/pictures/        validation pictures with detections, one sheet per epoch
RUN_DIR/tensorboard/     the same figures for TensorBoard
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detector.checkpoint import METADATA_KEY, ModelMetadata, check_weights, read_checkpoint
from detector.data.dataset import (
    ShardSource,
    StepSampler,
    TrainingSamples,
    ValidationSamples,
    label_provenance,
    make_loader,
    open_shards,
    open_sources,
)
from detector.model.anchor_fit import fit_anchors
from detector.model.retinanet import CcRetinaNet, build_model
from detector.training.config import MachineConfig, Preset
from detector.training.pretrained import load_pretrained
from labelgen.atomic_files import remove_temporary_files
from labelgen.errors import DataError, LabelgenError, OutputError
from labelgen.geometry import Region
from labelgen.geometry.homography import Array

__all__ = ["TrainSummary", "train"]

_INSTALL_HINT = "training needs Lightning and TensorBoard: pip install 'labelgen[train]'"
_LAST, _BEST = "last.ckpt", "best.ckpt"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainSummary:
    """Result of a training run.

    Args:
        steps: finished steps, those before a resumption included.
        epochs: finished epochs, likewise.
        checkpoint: file with the newest weights.
        best: file with the weights of the best validation; None without validation.
        metrics: last value of each logged figure, by name.
        interrupted: whether a signal stopped it.
        signal: number of that signal, for the exit code; None where there was none.
    """

    steps: int
    epochs: int
    checkpoint: Path
    best: Path | None
    metrics: dict[str, float]
    interrupted: bool
    signal: int | None = None


def train(
    shards: Sequence[str | Path],
    preset: Preset,
    out: str | Path,
    *,
    validation: Sequence[str | Path] = (),
    weights: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    seed: int = 0,
    machine: MachineConfig | None = None,
) -> TrainSummary:
    """Train a detector.

    Args:
        shards: files, folders, or PATH:WEIGHT, see `detector.data.dataset.open_sources`.
        preset: network and training; where it leaves pair and size open, they are those of the shards.
        out: run folder; see the module for what it holds.
        validation: shards on which the detector is evaluated after every epoch.
        weights: file of weights to start from, see `detector.training.pretrained`; None for those of the preset.
        resume: continue from the folder's last checkpoint. On a CPU the weights in the end are those of a run without
            interruption.
        overwrite: start a new run in a folder that holds one.
        seed: of weights, order and augmentation.
        machine: devices and loader processes; None for the defaults.

    Returns:
        the newest and the best checkpoint, and the last figures.

    Raises:
        DataError: shards of another pair or size, or weights that do not fit.
        OutputError: the folder holds a run and neither `resume` nor `overwrite` is given, another training is at work
            in it, or it cannot be written.
        LabelgenError: Lightning is not installed, the machine lacks what is asked for, the shards lack labels, a run is
            resumed with other settings, or the loss is not finite; the last checkpoint then stays.
    """
    out, machine = Path(out), machine or MachineConfig()
    try:
        from detector.training.machine import check_machine
        from detector.training.run_folder import locked_run_folder
    except ModuleNotFoundError as err:
        raise LabelgenError(f"{err.name} is not installed; {_INSTALL_HINT}") from None
    check_machine(machine, preset)
    with locked_run_folder(out):
        return _train(shards, preset, out, validation, weights, resume, overwrite, seed, machine)


def _train(
    shards: Sequence[str | Path], preset: Preset, out: Path, validation: Sequence[str | Path],
    weights: str | Path | None, resume: bool, overwrite: bool, seed: int, machine: MachineConfig,
) -> TrainSummary:  # fmt: skip
    """Train in a locked run folder; see `train`."""
    sources = open_sources(shards, preset.pair, preset.size_wh)
    metadata, steps = _plan(preset, sources, seed)
    validation_samples = None
    if validation:
        validation_samples = ValidationSamples(open_shards(validation, metadata.pair, metadata.size_wh))
    last = out / _LAST
    if resume:
        metadata = _metadata_of_resumed(last, metadata)
    elif last.exists() and not overwrite:
        raise OutputError(
            f"{out}: it holds a training run; resume it, or overwrite it", parameter=("resume", "overwrite")
        )
    remove_temporary_files(out)
    torch.manual_seed(seed)
    model = build_model(metadata.config, weights="none" if weights or resume else preset.weights)
    if weights is not None and not resume:
        loaded = load_pretrained(model, read_checkpoint(weights, f"weights {weights}"), f"weights {weights}")
        logger.info("starting from %s: weights of a %s", weights, loaded)
    samples = TrainingSamples(
        sources,
        metadata.size_wh,
        preset.whole,
        preset.crops,
        seed,
        ignore_boxes=preset.ignore_boxes,
        max_sigma=preset.max_sigma,
    )
    return _fit(model, preset, metadata, samples, validation_samples, steps, out, last if resume else None, machine)


def _plan(preset: Preset, sources: Sequence[ShardSource], seed: int) -> tuple[ModelMetadata, int]:
    """Work out the checkpoints' metadata and the number of steps in an epoch.

    Raises:
        LabelgenError: the shards have no labels to fit anchors to, or no c_c.
    """
    readers = [reader for source in sources for reader in source.shards.readers]
    pair = preset.pair or readers[0].pair
    pictures = [reader.size_wh for source in sources if not source.crops for reader in source.shards.readers]
    size_wh = preset.size_wh or (pictures[0] if pictures else (2 * readers[0].size_wh[0], 2 * readers[0].size_wh[1]))
    config = preset.model
    if preset.fit_anchors is not None:
        boxes = np.concatenate([_boxes(source, preset, size_wh) for source in sources])
        if not len(boxes):
            raise LabelgenError(f"{readers[0].path}: no labels to fit the anchors to")
        per_level, ratios = preset.fit_anchors
        sizes, shapes = fit_anchors(boxes, len(config.levels), per_level, ratios)
        config = replace(config, anchor_sizes=sizes, anchor_ratios=shapes)
    steps = preset.steps_per_epoch or max(1, sum(len(source.shards) for source in sources) // preset.batch)
    heights = [float(reader.settings.get("min_height_px", 0) or 0) for reader in readers]
    training = {
        "seed": seed, "batch": preset.batch, "epochs": preset.epochs, "steps_per_epoch": steps,
        "optimiser": preset.optimiser, "lr": preset.lr, "clip_norm": preset.clip_norm, "schedule": preset.schedule,
        "whole": asdict(preset.whole), "crops": asdict(preset.crops), "ignore_boxes": preset.ignore_boxes,
        **({} if preset.max_sigma is None else {"max_sigma": preset.max_sigma}),
    }  # fmt: skip
    metadata = ModelMetadata(preset.name, pair, size_wh, config, max(heights), label_provenance(sources), training)
    if metadata.region is Region.NONE and config.cc_weight:
        raise LabelgenError(
            f"{readers[0].path}: its pictures are not rectified, so there is no c_c; use the preset orig2d",
            parameter="preset",
        )
    return metadata, steps


def _boxes(source: ShardSource, preset: Preset, size_wh: tuple[int, int]) -> Array:
    """Return the boxes (N, 4) px of a source at the lower and at the upper quartile of augmentation's scales."""
    boxes: Array = source.shards.table("labels/box").astype(np.float64)
    ranges = preset.crops if source.crops else preset.whole
    base = np.divide(size_wh, source.shards.readers[0].size_wh) if source.crops else np.ones(2)
    quartiles = np.quantile(ranges.scale, [0.25, 0.75])
    return np.concatenate([boxes * np.tile(base, 2) * scale for scale in quartiles])


def _metadata_of_resumed(path: Path, metadata: ModelMetadata) -> ModelMetadata:
    """Return the metadata of the checkpoint to resume from.

    Raises:
        DataError: not a checkpoint.
        LabelgenError: it was made with other settings than those of `metadata`.
    """
    data = read_checkpoint(path)
    stored = ModelMetadata.from_dict(data.get(METADATA_KEY), f"checkpoint {path}")
    check_weights(data.get("state_dict"), stored, f"checkpoint {path}")
    settings = {
        "preset": (stored.preset, metadata.preset),
        "pair and size": ((stored.pair, stored.size_wh), (metadata.pair, metadata.size_wh)),
        "shards": (stored.labels, metadata.labels),
        **{key: (stored.training.get(key), value) for key, value in metadata.to_dict()["training"].items()},
    }
    changed = [name for name, (before, now) in settings.items() if _plain(before) != _plain(now)]
    if changed:
        raise LabelgenError(
            f"{path}: {', '.join(changed)} differ from those the run was started with; give the same, or start a new "
            "run from these weights",
            parameter="resume",
        )
    return stored


def _plain(value: Any) -> Any:
    """Turn tuples into lists, so that values from a checkpoint compare with those of a preset."""
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return {k: _plain(v) for k, v in value.items()} if isinstance(value, dict) else value


def _fit(
    model: CcRetinaNet, preset: Preset, metadata: ModelMetadata, samples: TrainingSamples,
    validation: ValidationSamples | None, steps: int, out: Path, resume_from: Path | None, machine: MachineConfig,
) -> TrainSummary:  # fmt: skip
    """Run Lightning's training loop."""
    try:
        import lightning.pytorch as pl

        from detector.training.callbacks import callbacks, loggers
        from detector.training.lightning_module import DetectorModule
        from detector.training.machine import AtomicCheckpoints, trainer_options
        from detector.training.run_folder import leftovers_of
    except ModuleNotFoundError as err:
        raise LabelgenError(f"{err.name} is not installed; {_INSTALL_HINT}") from None

    module = DetectorModule(model, preset, metadata, preset.epochs * steps, validation)
    checkpoints = AtomicCheckpoints(replaced=() if resume_from else leftovers_of(out))
    trainer = pl.Trainer(
        **trainer_options(machine, preset), max_epochs=preset.epochs, plugins=[checkpoints],
        gradient_clip_val=preset.clip_norm, logger=loggers(out), use_distributed_sampler=False,
        callbacks=callbacks(out, preset, validation is not None, machine), num_sanity_val_steps=0,
        enable_progress_bar=machine.progress, enable_model_summary=False, log_every_n_steps=10,
        default_root_dir=out,
    )  # fmt: skip
    batches = StepSampler(
        preset.batch, steps, lambda: trainer.global_step, lambda: (trainer.global_rank, trainer.world_size)
    )
    training_loader = make_loader(samples, batches=batches, workers=machine.workers)
    validation_loader = None
    if validation is not None:
        validation_loader = make_loader(validation, batch=preset.batch, workers=machine.workers)
    stopped_by = _run(trainer, module, training_loader, validation_loader, resume_from)
    best = out / _BEST
    metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    return TrainSummary(
        trainer.global_step, trainer.current_epoch, out / _LAST, best if best.exists() else None, metrics,
        stopped_by is not None, stopped_by,
    )  # fmt: skip


def _run(trainer: Any, module: Any, training: Any, validation: Any, resume_from: Path | None) -> int | None:
    """Run the loop; return the signal that stopped it, or None.

    Raises:
        DataError: the checkpoint to resume from is damaged.
    """
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    if is_main:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # Lightning ends a run between two steps
    try:
        trainer.fit(module, training, validation, ckpt_path=resume_from, weights_only=True)
    except SystemExit:  # Lightning's way to end after a signal
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return int(signal.SIGTERM if trainer.received_sigterm else signal.SIGINT)
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as err:
        if resume_from is None or module.has_begun:
            raise
        reason = " ".join(str(err).split())[:160] or type(err).__name__
        raise DataError(f"{resume_from}: damaged ({reason}); start a new run from its weights") from None
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, before)
    return None
