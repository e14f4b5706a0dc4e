"""Lightning's callbacks and loggers that write a run's checkpoints, logs and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping, LearningRateMonitor, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from detector.training.config import MachineConfig, Preset
from detector.training.lightning_module import VALIDATION_SCORE, DetectorModule
from detector.visualize import draw_sample, tile
from labelgen.media.image_file import write_image

__all__ = ["PredictionPictures", "callbacks", "loggers"]

_PICTURES = 8
"""Pictures on a sheet: more take longer to draw after every epoch."""


def loggers(out: Path) -> list[Logger]:
    """Return loggers that write CSV and TensorBoard files to subfolders of the run folder `out`."""
    return [CSVLogger(out, name="csv"), TensorBoardLogger(out, name="tensorboard")]


def callbacks(out: Path, preset: Preset, has_validation: bool, machine: MachineConfig) -> list[Callback]:
    """Return callbacks for checkpoints and learning rate; with validation also best checkpoint, stopping, pictures.

    Args:
        out: run folder.
        preset: says when to stop.
        has_validation: whether the detector is evaluated after every epoch.
        machine: says how often to save, and whether to show progress.
    """
    # Two savers of one file: at the end of every epoch, and within long ones.
    result: list[Callback] = [
        LearningRateMonitor("step"),
        _last(out, save_on_train_epoch_end=True, every_n_epochs=1),
    ]
    if machine.progress:
        result.append(TQDMProgressBar())
    if machine.checkpoint_every:
        result.append(_last(out, every_n_train_steps=machine.checkpoint_every))
    if has_validation:
        result += [
            ModelCheckpoint(
                out, filename="best", monitor=VALIDATION_SCORE, mode="max", save_top_k=1, enable_version_counter=False
            ),
            PredictionPictures(out / "pictures"),
        ]
        if preset.patience:
            result.append(EarlyStopping(VALIDATION_SCORE, mode="max", patience=preset.patience))
    return result


def _last(out: Path, **when: Any) -> ModelCheckpoint:
    return ModelCheckpoint(out, filename="last", save_top_k=1, monitor=None, enable_version_counter=False, **when)


class PredictionPictures(Callback):
    """Write a sheet of validation pictures with detections after each epoch, always of the same samples.

    Args:
        folder: of the sheets; made with the first.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the sheet to the folder and to TensorBoard."""
        if not trainer.is_global_zero or not isinstance(pl_module, DetectorModule):
            return
        pairs = pl_module.validation_pairs()
        shown = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, _PICTURES).astype(int))]
        sheet = tile([draw_sample(sample, detections) for sample, detections in shown])
        self._folder.mkdir(parents=True, exist_ok=True)
        write_image(self._folder / f"epoch-{trainer.current_epoch:03d}.jpg", sheet)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("detections", sheet[:, :, ::-1], trainer.global_step, dataformats="HWC")
