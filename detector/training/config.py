"""Named settings for training: the published ones, and a small one for two CPU cores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

from detector.data.augment import AugmentationRanges
from detector.model.retinanet import ModelConfig
from labelgen.errors import LabelgenError
from labelgen.geometry import Pair

__all__ = ["PRESETS", "Preset", "Trainer", "find_preset"]


PAPER_WHOLE = AugmentationRanges(translation=0.4, scale=(0.9, 2.0), flip=0.5)
PAPER_CROPS = AugmentationRanges(translation=0.5, scale=(0.03, 1.0), flip=0.5)


@dataclass(frozen=True)
class Preset:
    """How a detector is built and trained.

    Args:
        name: as the command line has it.
        pair: vanishing points of the shards it is for; None for any.
        size_wh: px of their pictures; None for any.
        model: shape of the network; its anchors are fitted to the shards where `fit_anchors` says so.
        fit_anchors: sizes per level and ratios to fit to the labels; None keeps the model's own anchors.
        weights: of the trunk.
        batch: samples per step and process.
        epochs, steps_per_epoch: length; 0 steps for one pass over the shards.
        optimiser: "adam" or "adamw".
        lr: learning rate, the highest there is.
        weight_decay: of "adamw".
        clip_norm: greatest norm of the gradient.
        schedule: "plateau": times 0.2 after 3 epochs without progress; "cosine": warm-up, then down to 0.
        warmup_steps: of "cosine".
        patience: epochs without progress on the validation shards after which training stops; 0 for never.
        half: train in mixed precision (bfloat16) where the device gains from it.
        whole, crops: augmentation of whole pictures and of BoxCars crops.
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
    half: bool = False
    whole: AugmentationRanges = PAPER_WHOLE
    crops: AugmentationRanges = PAPER_CROPS


def _presets() -> dict[str, Preset]:
    found = [
        Preset(f"paper-{w}x{h}", pair, (w, h), batch=8 if 960 in (w, h) else 16)
        for a, b in ((480, 270), (640, 360), (960, 540))
        for pair, w, h in ((Pair.VP2_VP3, a, b), (Pair.VP1_VP2, b, a))
    ]
    flat = ModelConfig(cc_weight=0.0)
    found += [Preset("transform2d", None, None, flat), Preset("orig2d", None, None, flat)]
    small = ModelConfig(
        backbone="resnet18", levels=(3, 4, 5), channels=64, head_convs=2, head_norm="group",
        anchor_sizes=((16.0, 24.0), (32.0, 48.0), (64.0, 96.0)),
        cc_weight=3.0, beta=0.02, size_weight=1.0, low_quality_matches=True,
    )  # fmt: skip
    found.append(
        Preset(
            "small", None, None, small, fit_anchors=(2, 3), weights="none", batch=8, epochs=12, steps_per_epoch=0,
            optimiser="adamw", lr=2e-3, weight_decay=0.01, clip_norm=5.0, schedule="cosine", warmup_steps=100,
            half=True,
            whole=AugmentationRanges(translation=0.15, scale=(0.8, 1.5), aspect=1.2, flip=0.5, light=0.25),
            crops=AugmentationRanges(translation=0.4, scale=(0.08, 0.8), aspect=1.2, flip=0.5, light=0.25),
        )
    )  # fmt: skip
    return {preset.name: preset for preset in found}


PRESETS: Mapping[str, Preset] = MappingProxyType(_presets())


def find_preset(name: str, **changes: object) -> Preset:
    """A preset by its name, with changes (None: as it is).

    Raises:
        LabelgenError: names the known ones.
    """
    if name not in PRESETS:
        raise LabelgenError(f"--preset {name}: unknown preset; use one of {', '.join(PRESETS)}")
    return replace(PRESETS[name], **{key: value for key, value in changes.items() if value is not None})  # type: ignore[arg-type]


@dataclass(frozen=True)
class Trainer:
    """What Lightning needs to know of the machine.

    Args:
        accelerator, devices, num_nodes, strategy, precision: as of Lightning's own Trainer; no precision for the
            preset's choice.
        workers: loader processes; 0 for none beside the training itself.
        checkpoint_every: steps between checkpoints within an epoch; 0 for the ends of epochs alone.
        progress: whether to show a bar.
    """

    accelerator: str = "auto"
    devices: Any = "auto"
    num_nodes: int = 1
    strategy: str = "auto"
    precision: Any = None
    workers: int = 0
    checkpoint_every: int = 500
    progress: bool = True
