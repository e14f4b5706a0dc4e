"""Feature pyramids on top of torchvision's classification networks (here called trunks)."""

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
"""Side of the image with which the strides of a trunk's stages are found; a multiple of 32."""


def group_norm(channels: int) -> nn.GroupNorm:
    """Return group normalisation with groups of at least eight channels."""
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
    """Build a trunk with a feature pyramid on top.

    Args:
        name: of a torchvision classification network that is a chain of stages, as in
            `torchvision.models.list_models()`: resnet18, resnet50, mobilenet_v3_large, convnext_tiny, ...
        levels: pyramid levels without gaps, 3 for stride 8 and so on; 6 and 7 are computed from 5, as in RetinaNet.
        channels: number of channels of every level.
        weights: "imagenet" for torchvision's pretrained weights, "none" for random ones.
        norm: normalisation inside the trunk, "batch" or "frozen"; networks without a choice keep their own.

    Raises:
        LabelgenError: no such network, it has no such levels, or its weights are not available.

    Source: Lin et al. 2017, "Feature Pyramid Networks for Object Detection"; levels 6 and 7: "Focal Loss", section 4.
    """
    net = _network(name, weights, norm)
    trunk = getattr(net, "features", net)
    stages = _stages(net, trunk)
    own = [level for level in levels if level <= 5]
    extra = [level for level in levels if level > 5]
    missing = [level for level in own if 2**level not in stages]
    if missing or list(levels) != list(range(levels[0], levels[-1] + 1)) or extra not in ([], [6, 7]) or not own:
        available = ", ".join(str(stride.bit_length() - 1) for stride in sorted(stages))
        raise LabelgenError(f"backbone {name}: no pyramid of the levels {list(levels)}; it has {available or None}")
    outputs = [stages[2**level] for level in own]
    return BackboneWithFPN(
        trunk,
        {child: str(level) for (child, _), level in zip(outputs, own, strict=True)},
        [count for _, count in outputs],
        channels,
        extra_blocks=LastLevelP6P7(channels, channels) if extra else _NoExtraLevel(),
    )


class _NoExtraLevel(LastLevelP6P7):  # type: ignore[misc]
    """No level above the trunk's own; without it, BackboneWithFPN adds a pooled one."""

    def __init__(self) -> None:
        nn.Module.__init__(self)

    def forward(self, p: Any, c: Any, names: Any) -> Any:
        """Return the levels unchanged."""
        return p, names


def _network(name: str, weights: str, norm: str) -> nn.Module:
    try:
        builder = models.get_model_builder(name)
    except ValueError:
        raise LabelgenError(
            f"backbone {name}: torchvision has no such network; see torchvision.models.list_models()"
        ) from None
    if weights not in ("none", "imagenet"):
        raise LabelgenError(f"weights {weights}: expected imagenet or none", parameter="weights")
    options: dict[str, Any] = {"weights": "DEFAULT" if weights == "imagenet" else None}
    if norm == "frozen":
        options["norm_layer"] = NORMS["frozen"]
    elif name.startswith("mobilenet_v3"):
        # Its own momentum of 0.01 is for long training: in a short one the running averages would lag behind.
        options["norm_layer"] = partial(nn.BatchNorm2d, eps=0.001, momentum=0.1)
    try:
        network: nn.Module = builder(**options)
    except OSError as err:
        raise LabelgenError(
            f"backbone {name}: its pretrained weights cannot be loaded ({err}); give torchvision's file of them, or a "
            "checkpoint, or none for random weights",
            parameter="weights",
        ) from None
    except TypeError as err:
        raise LabelgenError(f"backbone {name}: it cannot be built with {norm} normalisation ({err})") from None
    return network


def _stages(net: nn.Module, trunk: nn.Module) -> dict[int, tuple[str, int]]:
    """Find the stages of a trunk: stride -> name and channels of its last part at that stride."""
    stages: dict[int, tuple[str, int]] = {}

    def record(name: str, _: Any, __: Any, out: Any) -> None:
        if isinstance(out, torch.Tensor) and out.dim() == 4 and _PROBE_PX % out.shape[-1] == 0 and out.shape[-1] > 1:
            stages[_PROBE_PX // int(out.shape[-1])] = (name, int(out.shape[1]))

    hooks = [child.register_forward_hook(partial(record, name)) for name, child in trunk.named_children()]
    training = net.training
    net.eval()
    try:
        # A network for images of one fixed size fails here, and so has no stages.
        with torch.no_grad(), contextlib.suppress(RuntimeError, AssertionError):
            net(torch.zeros(1, 3, _PROBE_PX, _PROBE_PX))
    finally:
        net.train(training)
        for hook in hooks:
            hook.remove()
    return stages
