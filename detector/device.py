"""The machine a network runs on, and whether it gains from half precision there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from labelgen.errors import LabelgenError

__all__ = ["choose_device", "gains_from_half"]


def choose_device(name: str | None) -> torch.device:
    """The device of this name; the GPU when there is one, by default.

    Raises:
        LabelgenError: no such device here.
    """
    try:
        device = torch.device(name or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as err:
        raise LabelgenError(f"--device {name}: {' '.join(str(err).split())[:100]}; use cpu or cuda") from None
    return device


def gains_from_half(device: torch.device) -> bool:
    """Whether 16-bit convolutions are faster there: on GPUs, and on processors that multiply bfloat16 matrices."""
    if device.type != "cpu":
        return True
    # PyTorch tells since 2.10 or so; an older one that cannot tell runs in full precision, which is only slower.
    abilities: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return bool(abilities.get("amx_bf16") or abilities.get("sme2"))
