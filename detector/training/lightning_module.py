"""Lightning's module of the detector: training step, optimiser, schedule, validation, metadata in checkpoints."""

from __future__ import annotations

import math
from typing import Any

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor

from detector.checkpoint import METADATA_KEY, ModelMetadata
from detector.data.dataset import Batch, ValidationSamples
from detector.inference import labels_from_output
from detector.metrics import evaluate_detections
from detector.model.retinanet import CcRetinaNet
from detector.training.config import Preset
from labelgen.errors import LabelgenError
from labelgen.labels import Labels, Sample
from labelgen.torch_file import first_not_finite

__all__ = ["VALIDATION_SCORE", "DetectorModule"]

VALIDATION_SCORE = "val/ap50"
"""Name of the logged figure that selects the best checkpoint."""
_PLATEAU_FACTOR, _PLATEAU_PATIENCE = 0.2, 3
"""Factor on the learning rate, and epochs without progress before it: Kocur & Ftacnik 2020, section 3.4."""


class DetectorModule(LightningModule):
    """Train a detector.

    Args:
        model: the network.
        preset: optimiser and schedule.
        metadata: is written into every checkpoint.
        total_steps: number of steps of all epochs, for the cosine schedule.
        validation: samples that the validation loader draws from; None without validation.

    Attributes:
        has_begun: whether the loop of training has begun.
    """

    def __init__(
        self,
        model: CcRetinaNet,
        preset: Preset,
        metadata: ModelMetadata,
        total_steps: int,
        validation: ValidationSamples | None,
    ) -> None:
        super().__init__()
        self.model = model.to(memory_format=torch.channels_last)
        self._preset, self._metadata, self._total_steps = preset, metadata, total_steps
        self._validation = validation
        self._detections: dict[int, Labels] = {}
        self.has_begun = False

    def on_train_start(self) -> None:
        """Note that a checkpoint to resume from, if any, has been read."""
        self.has_begun = True

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of a batch, and log its terms.

        Raises:
            LabelgenError: the loss is not finite.
        """
        losses = self.model(_images(batch), batch.targets)
        total: Tensor = torch.stack(list(losses.values())).sum()
        if not torch.isfinite(total):
            raise self._diverged("the loss")
        self.log("train/loss", total, on_step=True, on_epoch=True, prog_bar=True, batch_size=len(batch))
        for name, value in losses.items():
            self.log(f"train/{name}", value, on_step=True, on_epoch=False, batch_size=len(batch))
        return total

    def on_validation_epoch_start(self) -> None:
        """Drop the detections of the last epoch."""
        self._detections = {}

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Detect vehicles in a batch."""
        outputs = self.model(_images(batch))
        for index, output, target in zip(batch.indices, outputs, batch.targets, strict=True):
            self._detections[index] = labels_from_output(output, target["scene"], self._metadata)

    def validation_pairs(self) -> list[tuple[Sample, Labels]]:
        """Return the samples of the last validation with their detections."""
        assert self._validation is not None
        return [(self._validation.shards[index], self._detections[index]) for index in sorted(self._detections)]

    def on_validation_epoch_end(self) -> None:
        """Evaluate the epoch's detections, and log average precision and errors."""
        result = evaluate_detections(self.validation_pairs(), min_height_px=self._metadata.min_height_px)
        figures = {
            VALIDATION_SCORE: result["ap50"],
            "val/ap": result["ap"],
            "val/ap50_whole": result["ap50_whole"],
            "val/cc_error": result["cc_error"]["median"],
            "val/ground_px": result["ground_px"]["median"],
        }
        for name, value in figures.items():
            # Without matched detections there is no error of c_c.
            number = math.nan if value is None else value
            self.log(name, torch.tensor(number, dtype=torch.float32, device=self.device), prog_bar=True, sync_dist=True)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Return optimiser and schedule of the preset."""
        preset = self._preset
        if preset.optimiser == "adamw":
            optimiser: torch.optim.Optimizer = torch.optim.AdamW(
                self._parameter_groups(preset.weight_decay), lr=preset.lr, weight_decay=preset.weight_decay
            )
        else:
            optimiser = torch.optim.Adam(self.parameters(), lr=preset.lr)
        if preset.schedule == "cosine":
            schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, self._cosine_factor)
            return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
        has_validation = self._validation is not None
        plateau = torch.optim.lr_scheduler.ReduceLROnPlateau(
            optimiser, mode="max" if has_validation else "min", factor=_PLATEAU_FACTOR, patience=_PLATEAU_PATIENCE
        )
        monitor = VALIDATION_SCORE if has_validation else "train/loss_epoch"
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": plateau, "interval": "epoch", "monitor": monitor}}

    def _diverged(self, what: str) -> LabelgenError:
        return LabelgenError(
            f"training has diverged: {what} is not finite after step {self.trainer.global_step}; lower the learning "
            f"rate ({self._preset.lr:g}), the last checkpoint, if any, is from before",
            parameter="lr",
        )

    def _parameter_groups(self, decay: float) -> list[dict[str, Any]]:
        """Split the parameters: weights decay, biases and normalisations do not."""
        parameters = [p for p in self.parameters() if p.requires_grad]
        return [
            {"params": [p for p in parameters if p.dim() > 1], "weight_decay": decay},
            {"params": [p for p in parameters if p.dim() <= 1], "weight_decay": 0.0},
        ]

    def _cosine_factor(self, step: int) -> float:
        """Return the factor on the learning rate in a step: linear warm-up, then a cosine down to 0."""
        warmup = min(self._preset.warmup_steps, self._total_steps // 2)
        if step < warmup:
            return (step + 1) / warmup
        progress = (step - warmup) / max(1, self._total_steps - warmup)
        return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the metadata to a checkpoint.

        Raises:
            LabelgenError: the weights are not finite; nothing is written then.
        """
        if first_not_finite(checkpoint.get("state_dict", {})) is not None:
            raise self._diverged("a weight")
        checkpoint[METADATA_KEY] = self._metadata.to_dict()


def _images(batch: Batch) -> list[Tensor]:
    """Return the images of a batch as the model takes them: (3, H, W) float32 in [0, 1]."""
    return list(batch.images.float() / 255)
