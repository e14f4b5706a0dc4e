"""The names of devices, the same in every command: auto, cpu, gpu, cuda, cuda:0, mps."""

from __future__ import annotations

import torch

from labelgen.before_torch import device_parts, no_such_device
from labelgen.errors import LabelgenError

__all__ = ["choose_device"]


def choose_device(name: str | None) -> torch.device:
    """Return a torch device that works on this machine.

    Args:
        name: "cpu", "cuda", "cuda:0", "mps", or "gpu" for whichever GPU there is; None and "auto" take CUDA's GPU where
            there is one, else the CPU.

    Raises:
        LabelgenError: no such name, or no such device on this machine.
    """
    kind, number = device_parts(name)
    has_cuda, has_mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    if kind == "auto":
        kind = "cuda" if has_cuda else "cpu"
    elif kind == "gpu":
        kind = "mps" if has_mps and not has_cuda and not number else "cuda"
    if (kind == "cuda" and not has_cuda) or (kind == "mps" and not has_mps):
        raise no_such_device(name)
    device = torch.device(f"{kind}{number}")
    if device.index is not None and device.index >= torch.cuda.device_count():
        raise LabelgenError(
            f"device {name}: this machine has {torch.cuda.device_count()} GPUs, numbered from 0", parameter="device"
        )
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as err:
        reason = " ".join(str(err).split())[:100]
        raise LabelgenError(f"device {name}: not usable here ({reason}); use cpu", parameter="device") from None
    return device
