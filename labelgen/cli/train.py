"""`labelgen train`."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from labelgen.before_torch import check_device, check_torch_file
from labelgen.cli.options import JsonOption, OverwriteOption, check_report_path, print_table, write_json_report
from labelgen.cli.printing import EndedBySignalError, say

__all__ = ["train"]


def train(
    shards: Annotated[
        list[str], typer.Argument(metavar="SHARDS...", help="Shards or folders of them; FOLDER:WEIGHT to mix.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="RUN_DIR", help="Where checkpoints and logs go.")],
    preset: Annotated[
        str,
        typer.Option("--preset", metavar="NAME", help="small, paper-640x360, ...; see docs/guides/train.md."),
    ] = "small",
    val: Annotated[
        list[str] | None, typer.Option("--val", metavar="SHARDS", help="Shards to judge by; may be given repeatedly.")
    ] = None,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="Instead of the preset's.")] = None,
    steps_per_epoch: Annotated[
        int | None, typer.Option("--steps-per-epoch", min=1, help="Instead of the preset's, or of one pass.")
    ] = None,
    batch: Annotated[int | None, typer.Option("--batch", min=1, help="Samples per step and device.")] = None,
    lr: Annotated[float | None, typer.Option("--lr", help="Learning rate instead of the preset's.")] = None,
    patience: Annotated[
        int | None, typer.Option("--patience", min=0, help="Stop after so many epochs without progress on --val.")
    ] = None,
    weights: Annotated[
        str | None,
        typer.Option(
            "--weights",
            metavar="FILE|imagenet|none",
            help="What to begin with; FILE: a checkpoint, torchvision's RetinaNet, or its file of the backbone.",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from RUN_DIR's last checkpoint.")] = False,
    overwrite: OverwriteOption = False,
    ignore_boxes: Annotated[
        bool,
        typer.Option(
            "--ignore-boxes/--no-ignore-boxes", help="Vehicles without a label count neither way, or: as road."
        ),
    ] = True,
    max_sigma: Annotated[
        float | None,
        typer.Option(
            "--max-sigma",
            min=0.0,
            metavar="C_C",
            help="Leave out labels whose stated standard deviation of c_c is larger.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of weights, order and augmentation.")] = 0,
    backbone: Annotated[
        str | None, typer.Option("--backbone", metavar="NAME", help="torchvision network instead of the preset's.")
    ] = None,
    precision: Annotated[
        str | None, typer.Option("--precision", help="Lightning's: 32-true, bf16-mixed, 16-mixed; the preset's choice.")
    ] = None,
    device: Annotated[str, typer.Option("--device", help="auto, cpu, gpu, cuda, cuda:0 or mps.")] = "auto",
    devices: Annotated[str, typer.Option("--devices", help="How many of them, or auto.")] = "auto",
    nodes: Annotated[int, typer.Option("--nodes", min=1, help="Machines, each started by your launcher.")] = 1,
    strategy: Annotated[str, typer.Option("--strategy", help="Lightning's: auto, ddp, ...")] = "auto",
    workers: Annotated[int, typer.Option("--workers", min=0, help="Loader processes.")] = 0,
    checkpoint_every: Annotated[
        int,
        typer.Option("--checkpoint-every", min=0, metavar="STEPS", help="Also within epochs; 0 for their ends only."),
    ] = 500,
    json_file: JsonOption = None,
) -> None:
    """Train the detector: RetinaNet with c_c.

    Killed or interrupted, the same command with --resume goes on: same data in the same order, and on a CPU the same
    weights in the end.
    """
    _check_shards([*shards, *(val or [])])
    check_device(device)
    check_report_path(json_file)
    if weights and weights not in ("imagenet", "none"):
        check_torch_file(Path(weights), f"weights {weights}", parameter="weights")
    from detector.training.config import MachineConfig, find_preset
    from detector.training.train import train as run

    named = weights in ("imagenet", "none")
    settings = find_preset(
        preset, epochs=epochs, steps_per_epoch=steps_per_epoch, batch=batch, lr=lr, patience=patience,
        weights=weights if named else None, ignore_boxes=ignore_boxes, max_sigma=max_sigma,
    )  # fmt: skip
    if backbone is not None:
        settings = replace(settings, model=replace(settings.model, backbone=backbone))
    machine = MachineConfig(
        device, int(devices) if re.fullmatch("[0-9]{1,9}", devices) else devices, nodes, strategy, precision, workers,
        checkpoint_every,
    )  # fmt: skip
    summary = run(
        shards, settings, out, validation=val or [], weights=Path(weights) if weights and not named else None,
        resume=resume, overwrite=overwrite, seed=seed, machine=machine,
    )  # fmt: skip
    saved = summary.checkpoint.exists()
    goes_on = "; the same command with --resume goes on" if saved else " before the first checkpoint"
    say(f"Trained {preset}" + (f", interrupted{goes_on}" if summary.interrupted else ""))
    rows = [("steps", summary.steps), ("epochs", summary.epochs)]
    rows += [(name, f"{value:.4f}") for name, value in sorted(summary.metrics.items())]  # type: ignore[misc]
    print_table([*rows, ("checkpoint", summary.checkpoint if saved else "-"), ("best", summary.best or "-")])
    # NaN, where there was nothing to measure, is no JSON.
    metrics = {name: value if math.isfinite(value) else None for name, value in summary.metrics.items()}
    write_json_report(
        json_file,
        {
            "preset": preset, "steps": summary.steps, "epochs": summary.epochs, "metrics": metrics,
            "checkpoint": str(summary.checkpoint) if saved else None,
            "best": None if summary.best is None else str(summary.best),
            "interrupted": summary.interrupted,
        },
    )  # fmt: skip
    if summary.signal is not None:
        raise EndedBySignalError(summary.signal, goes_on.removeprefix("; ").strip())


def _check_shards(shards: list[str]) -> None:
    """Refuse shards that are not there, given as PATH or PATH:WEIGHT."""
    from labelgen.shards import find_shards

    for text in shards:
        path, colon, _ = text.rpartition(":")
        find_shards([text if Path(text).exists() or not colon else path])
