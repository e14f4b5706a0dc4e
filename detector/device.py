"""Torch devices: which one to use, and whether it gains from half precision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from labelgen.torch_device import choose_device

__all__ = ["choose_device", "gains_from_half"]


def gains_from_half(device: torch.device) -> bool:
    """Tell whether 16-bit convolutions are faster: on GPUs, and on processors that multiply bfloat16 matrices."""
    if device.type != "cpu":
        return True
    # Older versions of PyTorch cannot tell; full precision is then only slower.
    abilities: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(abilities.get("amx_bf16") or abilities.get("sme2"))
