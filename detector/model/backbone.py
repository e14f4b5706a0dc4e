"""Any torchvision classification network as the trunk of a feature pyramid."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import nn
from torchvision import models
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.ops.feature_pyramid_network import LastLevelP6P7
from torchvision.ops.misc import FrozenBatchNorm2d

from labelgen.errors import LabelgenError

__all__ = ["NORMS", "build_backbone", "group_norm"]

_PROBE_PX = 128


def group_norm(channels: int) -> nn.GroupNorm:
    """Group normalisation with groups of at least eight channels."""
    return nn.GroupNorm(max(1, channels // 8), channels)


NORMS: dict[str, Callable[..., nn.Module] | None] = {
    "none": None,
    "batch": nn.BatchNorm2d,
    "frozen": FrozenBatchNorm2d,
    "group": group_norm,
}


def build_backbone(
    name: str, levels: Sequence[int], channels: int, *, weights: str = "none", norm: str = "batch"
) -> BackboneWithFPN:
    """A trunk with a feature pyramid on top.

    Args:
        name: of a torchvision classification network, as `torchvision.models.list_models()` has it, made of a chain
            of stages: resnet18, resnet50, mobilenet_v3_large, efficientnet_b0, convnext_tiny, ...
        levels: pyramid levels, 3 for stride 8 and so on, without gaps; 6 and 7 are made from 5, as in RetinaNet.
        channels: of every level.
        weights: "imagenet" for torchvision's pretrained weights, "none" for random ones.
        norm: normalisation inside the trunk, "batch" or "frozen"; networks without a choice keep their own.

    Raises:
        LabelgenError: no such network, it has no such levels, or its weights cannot be had.
    """
    net = _network(name, weights, norm)
    trunk = getattr(net, "features", net)
    stages = _stages(net, trunk)
    own = [level for level in levels if level <= 5]
    extra = [level for level in levels if level > 5]
    missing = [level for level in own if 2**level not in stages]
    if missing or list(levels) != list(range(levels[0], levels[-1] + 1)) or extra not in ([], [6, 7]) or not own:
        there = ", ".join(str(stride.bit_length() - 1) for stride in sorted(stages))
        raise LabelgenError(f"backbone {name}: no pyramid of the levels {list(levels)}; it has {there or None}")
    chosen = [stages[2**level] for level in own]
    return BackboneWithFPN(
        trunk,
        {child: str(level) for (child, _), level in zip(chosen, own, strict=True)},
        [count for _, count in chosen],
        channels,
        extra_blocks=LastLevelP6P7(channels, channels) if extra else _NoExtraLevel(),
    )


class _NoExtraLevel(LastLevelP6P7):  # type: ignore[misc]
    """Nothing above the trunk's own levels; without it, BackboneWithFPN adds a pooled one."""

    def __init__(self) -> None:
        nn.Module.__init__(self)

    def forward(self, p: Any, c: Any, names: Any) -> Any:
        """The levels as they are."""
        return p, names


def _network(name: str, weights: str, norm: str) -> nn.Module:
    try:
        builder = models.get_model_builder(name)
    except ValueError:
        raise LabelgenError(
            f"backbone {name}: torchvision has no such network; see torchvision.models.list_models()"
        ) from None
    if weights not in ("none", "imagenet"):
        raise LabelgenError(f"--weights {weights}: expected imagenet, none or a file")
    options: dict[str, Any] = {"weights": "DEFAULT" if weights == "imagenet" else None}
    if norm == "frozen":
        options["norm_layer"] = NORMS["frozen"]
    elif name.startswith("mobilenet_v3"):
        # Its own momentum of 0.01 is for long trainings: in a short one the running averages would lag behind.
        options["norm_layer"] = partial(nn.BatchNorm2d, eps=0.001, momentum=0.1)
    try:
        network: nn.Module = builder(**options)
    except OSError as err:
        raise LabelgenError(
            f"backbone {name}: its pretrained weights cannot be had ({err}); give torchvision's file of them, or a "
            "checkpoint, with --weights FILE, or begin from random ones with --weights none"
        ) from None
    except TypeError as err:
        raise LabelgenError(f"backbone {name}: it cannot be built with {norm} normalisation ({err})") from None
    return network


def _stages(net: nn.Module, trunk: nn.Module) -> dict[int, tuple[str, int]]:
    """Stride -> name and channels of the last part of the trunk at that stride."""
    found: dict[int, tuple[str, int]] = {}

    def note(name: str, _: Any, __: Any, out: Any) -> None:
        if isinstance(out, torch.Tensor) and out.dim() == 4 and _PROBE_PX % out.shape[-1] == 0 and out.shape[-1] > 1:
            found[_PROBE_PX // int(out.shape[-1])] = (name, int(out.shape[1]))

    hooks = [child.register_forward_hook(partial(note, name)) for name, child in trunk.named_children()]
    training = net.training
    net.eval()
    try:
        # A network that takes pictures of one size only has no stages for us.
        with torch.no_grad(), contextlib.suppress(RuntimeError, AssertionError):
            net(torch.zeros(1, 3, _PROBE_PX, _PROBE_PX))
    finally:
        net.train(training)
        for hook in hooks:
            hook.remove()
    return found
