"""Settings for training: named presets (the published ones, and a small one for two CPU cores) and the machine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

from detector.data.augment import AugmentationRanges
from detector.model.retinanet import ModelConfig
from labelgen.errors import LabelgenError
from labelgen.geometry import Pair

__all__ = ["PRESETS", "MachineConfig", "Preset", "find_preset"]

_PAPER_WHOLE = AugmentationRanges(translation=0.4, scale=(0.9, 2.0), flip=0.5)
_PAPER_CROPS = AugmentationRanges(translation=0.5, scale=(0.03, 1.0), flip=0.5)
"""Augmentation of whole pictures and of crops in Kocur & Ftacnik 2020, section 3.4."""


@dataclass(frozen=True)
class Preset:
    """How a detector is built and trained.

    Args:
        name: of the preset.
        pair: vanishing points made axis-parallel in the shards; None for any.
        size_wh: width, height px of the shards' pictures; None for any.
        model: shape and loss of the network; `fit_anchors` may replace its anchors.
        fit_anchors: number of sizes per level and of ratios to fit to the labels; None keeps the model's anchors.
        weights: of the trunk at the start, "imagenet" or "none" for random ones.
        batch: samples per step and process.
        epochs: number of epochs.
        steps_per_epoch: steps in an epoch; 0 for one pass over the shards.
        optimiser: "adam" or "adamw".
        lr: highest learning rate.
        weight_decay: of "adamw", per step and unit of learning rate.
        clip_norm: largest norm of the gradient; a larger one is scaled down to it.
        schedule: of the learning rate. "plateau": times 0.2 after more than 3 epochs without progress; "cosine":
            linear warm-up, then down to 0 along a cosine.
        warmup_steps: steps of the warm-up of "cosine", at most half of all steps.
        patience: epochs without progress on the validation shards after which training stops; 0 for never.
        ignore_boxes: whether vehicles without a label are left out of the loss, see `TrainingSamples`.
        max_sigma: labels whose stated standard deviation of c_c is larger are left out of the loss; None to keep all.
        half: train in mixed precision (bfloat16) where the device gains from it.
        whole: augmentation of whole pictures.
        crops: augmentation of BoxCars116k's crops.

    Source: the defaults are those of Kocur & Ftacnik 2020, section 3.4.
    """

    name: str
    pair: Pair | None
    size_wh: tuple[int, int] | None
    model: ModelConfig = field(default_factory=ModelConfig)
    fit_anchors: tuple[int, int] | None = None
    weights: str = "imagenet"
    batch: int = 16
    epochs: int = 30
    steps_per_epoch: int = 10000
    optimiser: Literal["adam", "adamw"] = "adam"
    lr: float = 1e-5
    weight_decay: float = 0.0
    clip_norm: float = 1e-3
    schedule: Literal["plateau", "cosine"] = "plateau"
    warmup_steps: int = 0
    patience: int = 0
    ignore_boxes: bool = True
    max_sigma: float | None = None
    half: bool = False
    whole: AugmentationRanges = _PAPER_WHOLE
    crops: AugmentationRanges = _PAPER_CROPS


def _presets() -> dict[str, Preset]:
    presets = [
        Preset(f"paper-{w}x{h}", pair, (w, h), batch=8 if 960 in (w, h) else 16)
        for a, b in ((480, 270), (640, 360), (960, 540))
        for pair, w, h in ((Pair.VP2_VP3, a, b), (Pair.VP1_VP2, b, a))
    ]
    flat = ModelConfig(cc_weight=0.0)
    presets += [Preset("transform2d", None, None, flat), Preset("orig2d", None, None, flat)]
    small = ModelConfig(
        backbone="resnet18", levels=(3, 4, 5), channels=64, head_convs=2, head_norm="group",
        anchor_sizes=((16.0, 24.0), (32.0, 48.0), (64.0, 96.0)),
        cc_weight=3.0, beta=0.02, size_weight=1.0, low_quality_matches=True,
    )  # fmt: skip
    presets.append(
        Preset(
            "small", None, None, small, fit_anchors=(2, 3), weights="none", batch=8, epochs=12, steps_per_epoch=0,
            optimiser="adamw", lr=2e-3, weight_decay=0.01, clip_norm=5.0, schedule="cosine", warmup_steps=100,
            half=True,
            whole=AugmentationRanges(translation=0.15, scale=(0.8, 1.5), aspect=1.2, flip=0.5, light=0.25),
            crops=AugmentationRanges(translation=0.4, scale=(0.08, 0.8), aspect=1.2, flip=0.5, light=0.25),
        )
    )  # fmt: skip
    return {preset.name: preset for preset in presets}


PRESETS: Mapping[str, Preset] = MappingProxyType(_presets())
"""All presets by name."""


def find_preset(name: str, **changes: object) -> Preset:
    """Return a preset, with changes.

    Args:
        name: of the preset.
        changes: new values of its fields; None leaves a field as it is.

    Raises:
        LabelgenError: no such preset, and the message lists all; or a learning rate that is not a positive number.
    """
    if name not in PRESETS:
        raise LabelgenError(f"preset {name}: unknown; use one of {', '.join(PRESETS)}", parameter="preset")
    lr = changes.get("lr")
    if lr is not None and not (isinstance(lr, int | float) and math.isfinite(lr) and lr > 0):
        raise LabelgenError(f"lr {lr}: expected a positive number, for instance 0.001", parameter="lr")
    return replace(PRESETS[name], **{key: value for key, value in changes.items() if value is not None})  # type: ignore[arg-type]


@dataclass(frozen=True)
class MachineConfig:
    """Where and how training runs.

    Args:
        accelerator: kind of device: "auto", "cpu", "gpu", "cuda", "cuda:0" or "mps", see `labelgen.torch_device`.
        devices: number of devices per machine, or "auto".
        num_nodes: number of machines.
        strategy: Lightning's name of how processes work together: "auto", "ddp", ...
        precision: Lightning's name of the precision, for instance "bf16-mixed"; None for the preset's choice.
        workers: loader processes; 0 to load in the training process.
        checkpoint_every: steps between checkpoints within an epoch; 0 for checkpoints at the ends of epochs alone.
            Fewer steps lose less work in an interruption and cost more writing.
        progress: whether to show a progress bar.
    """

    accelerator: str = "auto"
    devices: Any = "auto"
    num_nodes: int = 1
    strategy: str = "auto"
    precision: Any = None
    workers: int = 0
    checkpoint_every: int = 500
    progress: bool = True
