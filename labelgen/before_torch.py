"""Checks of what PyTorch is to use that need no PyTorch: importing it takes seconds."""

from __future__ import annotations

import errno
import os
import re
import sys
from pathlib import Path

from labelgen.errors import DataError, LabelgenError

__all__ = ["check_device", "check_torch_file", "device_parts", "no_such_device"]

_NAMES = "auto, cpu, gpu, cuda, cuda:0, mps"
# Device files of which a GPU under Linux has at least one: NVIDIA's, those of its small boards and of WSL, and AMD's.
_GPU_FILES = ("nvidia*", "nvhost*", "nvmap", "dxg", "kfd", "dri/renderD*")


def device_parts(name: str | None) -> tuple[str, str]:
    """Return kind and number of a device, such as ("cuda", ":0"); "auto" where none is named.

    Raises:
        LabelgenError: no such name.
    """
    match = re.fullmatch(r"(auto|cpu|mps|gpu|cuda)(:[0-9]{1,3})?", (name or "auto").strip().lower())
    if match is None or (match[2] and match[1] not in ("gpu", "cuda")):
        raise LabelgenError(f"device {name}: unknown; use one of {_NAMES}", parameter="device")
    return match[1], match[2] or ""


def no_such_device(name: str | None) -> LabelgenError:
    """Return the error about a device that this machine lacks."""
    return LabelgenError(
        f"device {name}: this machine has no such GPU, or PyTorch cannot use it; use cpu", parameter="device"
    )


def check_device(name: str | None) -> None:
    """Refuse the name of a device that cannot be; whether PyTorch can use it, `choose_device` finds out.

    Args:
        name: as `labelgen.torch_device.choose_device` takes it.

    Raises:
        LabelgenError: no such name, or no such device on this machine.
    """
    kind, _ = device_parts(name)
    has_files = not sys.platform.startswith("linux") or any(any(Path("/dev").glob(names)) for names in _GPU_FILES)
    if (kind in ("cuda", "gpu") and not has_files) or (kind == "mps" and sys.platform != "darwin"):
        raise no_such_device(name)


def check_torch_file(path: Path, label: str, *, parameter: str | None = None) -> None:
    """Refuse a file of weights that is not there.

    Args:
        path: of the file.
        label: its name in the error.
        parameter: see `LabelgenError`.

    Raises:
        DataError: no such file.
    """
    if not os.path.exists(path):
        raise DataError(f"{label}: {os.strerror(errno.ENOENT)}", parameter=parameter)
