"""What a training leaves in its folder: checkpoints, logs, pictures. Needs Lightning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from lightning.pytorch import Callback, LightningModule
from lightning.pytorch import Trainer as LightningTrainer
from lightning.pytorch.callbacks import EarlyStopping, LearningRateMonitor, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from detector.training.config import Preset
from detector.training.lightning_module import VALIDATION_SCORE, DetectorModule
from detector.visualize import draw_sample, tile

if TYPE_CHECKING:
    from detector.training.config import Trainer

__all__ = ["PredictionPictures", "callbacks", "loggers"]

_PICTURES = 8


def loggers(out: Path) -> list[Logger]:
    """CSV and TensorBoard."""
    return [CSVLogger(out, name="csv"), TensorBoardLogger(out, name="tensorboard")]


def callbacks(out: Path, preset: Preset, judged: bool, machine: Trainer) -> list[Callback]:
    """Checkpoints, learning rate, and with validation the best checkpoint, early stopping and pictures."""
    # Two savers with one file name: at the end of every epoch, and within long ones.
    found: list[Callback] = [
        LearningRateMonitor("step"),
        _last(out, save_on_train_epoch_end=True, every_n_epochs=1),
    ]
    if machine.progress:
        found.append(TQDMProgressBar())
    if machine.checkpoint_every:
        found.append(_last(out, every_n_train_steps=machine.checkpoint_every))
    if judged:
        found += [
            ModelCheckpoint(
                out, filename="best", monitor=VALIDATION_SCORE, mode="max", save_top_k=1, enable_version_counter=False
            ),
            PredictionPictures(out / "pictures"),
        ]
        if preset.patience:
            found.append(EarlyStopping(VALIDATION_SCORE, mode="max", patience=preset.patience))
    return found


def _last(out: Path, **when: Any) -> ModelCheckpoint:
    return ModelCheckpoint(out, filename="last", save_top_k=1, monitor=None, enable_version_counter=False, **when)


class PredictionPictures(Callback):
    """After each validation a sheet of pictures with detections, the same pictures each time.

    Args:
        folder: where sheets go; made when there is the first.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def on_validation_epoch_end(self, trainer: LightningTrainer, pl_module: LightningModule) -> None:
        """Write the sheet, for TensorBoard as well."""
        if not trainer.is_global_zero or not isinstance(pl_module, DetectorModule):
            return
        pairs = pl_module.validation_pairs()
        chosen = [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, _PICTURES).astype(int))]
        sheet = tile([draw_sample(sample, found) for sample, found in chosen])
        self._folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(self._folder / f"epoch-{trainer.current_epoch:03d}.jpg"), sheet)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("detections", sheet[:, :, ::-1], trainer.global_step, dataformats="HWC")
