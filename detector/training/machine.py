"""Lightning's trainer for a machine: what is wrong or not available is one line before anything is written."""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO

from detector.device import gains_from_half
from detector.training.config import MachineConfig, Preset
from labelgen.atomic_files import write_atomic
from labelgen.errors import LabelgenError
from labelgen.torch_device import choose_device

__all__ = ["AtomicCheckpoints", "check_machine", "trainer_options"]

_MAX_PROCESSES = 64
_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed", "bf16-true", "16-true", "64-true", "32", "bf16", "16", "64")


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes checkpoints to a temporary file in the run folder, flushes it to disk and renames it.

    Lightning's own writer copies over the old checkpoint where the folder of temporary files lies on another file
    system; a kill in between would destroy it.

    Args:
        replaced: files of an older run in the folder, which go when the first checkpoint of this one comes.
    """

    def __init__(self, replaced: Sequence[Path] = ()) -> None:
        super().__init__()
        self._replaced = tuple(replaced)

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Write a checkpoint.

        Raises:
            OutputError: it cannot be written; the old one stays.
        """
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_atomic(Path(path), buffer.getbuffer())
        for old in self._replaced:
            if old != Path(path):
                old.unlink(missing_ok=True)
        self._replaced = ()


def trainer_options(machine: MachineConfig, preset: Preset) -> dict[str, Any]:
    """Return the options of Lightning's `Trainer` that say where and how training runs.

    Raises:
        LabelgenError: an unknown or unavailable device, number of devices or precision.
    """
    device = choose_device(machine.accelerator)
    accelerator, devices = device.type, machine.devices
    if machine.accelerator == "auto" and device.type == "cpu":
        accelerator = "auto"
    if device.index is not None:
        if devices not in ("auto", 1):
            raise LabelgenError(
                f"devices {devices}: device {machine.accelerator} names one of them; give one of the two",
                parameter=("devices", "device"),
            )
        devices = [device.index]
    elif devices != "auto":
        available = torch.cuda.device_count() if device.type == "cuda" else 1 if device.type == "mps" else None
        most = max(_MAX_PROCESSES, os.cpu_count() or 1) if available is None else available
        if not isinstance(devices, int) or isinstance(devices, bool) or not 1 <= devices <= most:
            there = "" if available is None else f"; this machine has {available}"
            raise LabelgenError(
                f"devices {devices}: expected a number from 1 to {most}, or auto{there}", parameter="devices"
            )
    precision = machine.precision
    if precision is None:
        precision = "bf16-mixed" if preset.half and gains_from_half(device) else "32-true"
    elif str(precision) not in _PRECISIONS:
        raise LabelgenError(
            f"precision {precision}: unknown; use one of {', '.join(_PRECISIONS)}", parameter="precision"
        )
    elif str(precision) in ("16-mixed", "16-true", "16") and device.type == "cpu":
        raise LabelgenError(
            f"precision {precision}: a CPU cannot train in it; use 32-true or bf16-mixed", parameter="precision"
        )
    return {
        "accelerator": accelerator, "devices": devices, "num_nodes": machine.num_nodes, "strategy": machine.strategy,
        "precision": precision,
    }  # fmt: skip


def check_machine(machine: MachineConfig, preset: Preset) -> None:
    """Check that training can run as asked for on this machine, before anything is read or written.

    Raises:
        LabelgenError: an unknown or unavailable device, number of devices, strategy or precision.
    """
    options = trainer_options(machine, preset)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            Trainer(
                **options, logger=False, enable_checkpointing=False, enable_progress_bar=False,
                enable_model_summary=False,
            )  # fmt: skip
    except (
        MisconfigurationException, ValueError, TypeError, RuntimeError, ImportError, AttributeError, KeyError, OSError,
    ) as err:  # fmt: skip
        raise _refused(machine, err) from None


def _refused(machine: MachineConfig, err: Exception) -> LabelgenError:
    reason = " ".join(str(err).split())[:200]
    if machine.strategy != "auto":
        return LabelgenError(
            f"strategy {machine.strategy}: not available here ({reason}); use auto or ddp", parameter="strategy"
        )
    return LabelgenError(
        f"Lightning cannot train so on this machine ({reason})", parameter=("device", "devices", "precision")
    )
