"""The names of devices, the same in every command: auto, cpu, gpu, cuda, cuda:0, mps."""

from __future__ import annotations

import re

import torch

from labelgen.errors import LabelgenError

__all__ = ["choose_device"]

_NAMES = "auto, cpu, gpu, cuda, cuda:0, mps"


def choose_device(name: str | None) -> torch.device:
    """Return a torch device that works on this machine.

    Args:
        name: "cpu", "cuda", "cuda:0", "mps", or "gpu" for whichever GPU there is; None and "auto" take CUDA's GPU where
            there is one, else the CPU.

    Raises:
        LabelgenError: no such name, or no such device on this machine.
    """
    text = (name or "auto").strip().lower()
    match = re.fullmatch(r"(auto|cpu|mps|gpu|cuda)(:[0-9]{1,3})?", text)
    if match is None or (match[2] and match[1] not in ("gpu", "cuda")):
        raise LabelgenError(f"device {name}: unknown; use one of {_NAMES}", parameter="device")
    kind, number = match[1], match[2] or ""
    has_cuda, has_mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    if kind == "auto":
        kind = "cuda" if has_cuda else "cpu"
    elif kind == "gpu":
        kind = "mps" if has_mps and not has_cuda and not number else "cuda"
    if (kind == "cuda" and not has_cuda) or (kind == "mps" and not has_mps):
        raise LabelgenError(
            f"device {name}: this machine has no such GPU, or PyTorch cannot use it; use cpu", parameter="device"
        )
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
