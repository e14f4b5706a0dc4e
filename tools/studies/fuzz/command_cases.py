"""Makers of cases of the command line: good files, and options whose value is seldom what is expected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer.main

from labelgen.cli.main import app
from tools.studies.fuzz.good_files import SHORT_TRAINING, Case, Rng, bcs_masks, scene_options

__all__ = ["options_case"]

# Values that ask for no more work than a good one.
_VALUES = (
    "", " ", "x", "-1", "0", "nan", "inf", "-inf", "1e400", "1e-300", "0x10", "1_0", "\u0663", "1,2", "1,nan", "=1+1",
    "\x1b[2J", "\udcff", "a" * 5000, "-", "--out", "../x", "0x0", "1x1", "99999999x1", "7x", "cuda:99", "meta", "none",
    "imagenet", "masks:coco:", "model:", "coco:", "coco:nowhere", "detections:", "2=car,2=bus", "=", "auto",
    "distance:1",
)  # fmt: skip


def options_case(rng: Rng, good: Path, work: Path) -> Case:
    """Return a command on good files with one or two options of strange values."""
    masks, out = f"masks:coco:{good / 'masks.json'}", ["--out", work / "out"]
    model, shards = good / "last.ckpt", good / "shards"
    scene, cpu = scene_options(good), ["--device", "cpu"]
    short = ["--duration", 0.2, "--fps", 5, "--size", "160x90", "--no-video"]
    commands: list[list[object]] = [
        ["speed", good / "road.mp4", "--from", masks, *scene, *out],
        ["speed", good / "road.mp4", "--from", f"model:{model}", *cpu, *scene, *out],
        bcs_masks(good, work / "out"),
        ["calibrate", good / "road.mp4", "--out", work / "out.json"],
        ["road-mask", good / "road.mp4", "--out", work / "out.png"],
        ["rectify", good / "road.mp4", *scene, "--out", work / "out.png"],
        ["detect", model, good / "road.mp4", *cpu, *scene, *out],
        ["detect", model, shards, *cpu, *out],
        ["test-detector", model, shards, *cpu],
        ["export-model", model, "--out", work / "out.onnx"],
        ["boxcars", "--root", good / "tree", *out, "--cameras", "all", "--all-directions"],
        ["merge", shards, *out],
        ["inspect", shards],
        ["validate", shards],
        ["audit", shards, *out, "--count", 3],
        ["train", shards, *SHORT_TRAINING, "--epochs", 1, *out],
        ["evaluate", "--dataset", good / "dataset", "--results", good / "results", "--system", "a"],
        ["synth", "session", *short, *out],
        ["synth", "boxcars", "--vehicles", 1, *out],
    ]
    arguments = commands[rng.integers(len(commands))]
    options = _options_of(arguments)
    changes = []
    for _ in range(int(rng.integers(1, 3))):
        option = options[rng.integers(len(options))]
        value = _VALUES[rng.integers(len(_VALUES))]
        if option in ("--out", "--name") and value in ("", ".", "-", "nan", "inf", "-inf"):
            continue
        if option in arguments:
            place = arguments.index(option) + 1
            arguments = [*arguments[:place], value, *arguments[place + 1 :]]
        else:
            arguments = [*arguments, option, value]
        changes.append(f"{option} {value[:40]!r}")
    return arguments, ", ".join(changes)


def _options_of(arguments: list[object]) -> list[str]:
    """Return the options of a command that take a value."""
    command: Any = typer.main.get_command(app)
    for word in arguments[:2]:
        below = command.get_command(None, str(word)) if hasattr(command, "get_command") else None
        command = below or command
    return [
        parameter.opts[0]
        for parameter in command.params
        if parameter.opts[0].startswith("--") and not _is_flag(parameter)
    ]


def _is_flag(parameter: Any) -> bool:
    return bool(getattr(parameter, "is_flag", False))
