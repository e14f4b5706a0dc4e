"""Torch devices: which one to use, and whether it gains from half precision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from labelgen.errors import LabelgenError

__all__ = ["choose_device", "gains_from_half"]


def choose_device(name: str | None) -> torch.device:
    """Return a torch device.

    Args:
        name: as torch has it, for instance "cpu" or "cuda:0"; None for the GPU where there is one, else the CPU.

    Raises:
        LabelgenError: no such device on this machine.
    """
    try:
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as err:
        reason = " ".join(str(err).split())[:100]
        raise LabelgenError(f"device {name}: {reason}; use cpu or cuda", parameter="device") from None
    return device


def gains_from_half(device: torch.device) -> bool:
    """Tell whether 16-bit convolutions are faster: on GPUs, and on processors that multiply bfloat16 matrices."""
    if device.type != "cpu":
        return True
    # Older versions of PyTorch cannot tell; full precision is then only slower.
    abilities: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(abilities.get("amx_bf16") or abilities.get("sme2"))
