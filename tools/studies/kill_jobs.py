"""The commands of the study of kills: what they read, and their arguments for older and for newer results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

__all__ = ["JOBS", "Job", "command_of", "input_commands"]

_SIZE, _SECONDS = "320x180", 1.2


class Job(NamedTuple):
    """A command, with arguments for older and for newer results."""

    arguments: Callable[[Path, bool], list[object]]
    may_be_shorter: bool = False
    """Whether Ctrl-C leaves a shorter result that is whole in itself."""
    resumes: bool = False
    """Whether a new run over an older one that was begun continues with another option than `--overwrite`."""


def _session(root: Path) -> Path:
    return root / "data" / "dataset" / "session0_center"


def _masks(root: Path) -> str:
    return f"coco:{root / 'data' / 'truth' / 'session0_center' / 'masks.json'}"


def _train(root: Path, new: bool) -> list[object]:
    return [
        "train", root / "shards", "--preset", "small", "--epochs", 2, "--steps-per-epoch", 2, "--batch", 1,
        "--weights", "none", "--device", "cpu", "--checkpoint-every", 1, "--seed", int(new),
    ]  # fmt: skip


JOBS: dict[str, Job] = {
    "synth session": Job(
        lambda root, new: ["synth", "session", "--size", _SIZE, "--duration", 0.4, "--seed", int(new)],
        may_be_shorter=True,
    ),
    "synth boxcars": Job(lambda root, new: ["synth", "boxcars", "--vehicles", 2, "--seed", int(new)]),
    "boxcars": Job(
        lambda root, new: [
            "boxcars",
            "--root",
            root / "tree",
            "--cameras",
            "all",
            "--all-directions",
            "--per-shard",
            2,
            "--workers",
            1,
            "--size",
            "64x64" if new else "96x64",
        ]
    ),
    "bcs-masks": Job(
        lambda root, new: [
            "bcs-masks",
            _session(root),
            "--masks",
            _masks(root),
            "--every",
            4 if new else 6,
            "--size",
            "160x96",
            "--per-shard",
            3,
            "--min-height",
            3,
        ]
    ),
    "merge": Job(lambda root, new: ["merge", root / "shards", *([root / "exact"] if new else [])]),
    "speed": Job(
        lambda root, new: [
            "speed",
            _session(root),
            "--from",
            f"masks:{_masks(root)}",
            "--render",
            "--size",
            "320x180" if new else "160x96",
        ]
    ),
    "detect": Job(
        lambda root, new: [
            "detect",
            root / "run" / "last.ckpt",
            root / "shards",
            "--device",
            "cpu",
            "--render",
            "--score",
            0.0,
            "--limit",
            3 if new else 5,
        ]
    ),
    "audit": Job(lambda root, new: ["audit", root / "shards", "--count", 4 if new else 12]),
    "rectify": Job(
        lambda root, new: ["rectify", _session(root), "--size", "160x96" if new else "96x160"],
    ),
    "evaluate": Job(
        lambda root, new: [
            "evaluate",
            "--dataset",
            root / "data" / "dataset",
            "--results",
            root / "data" / "results",
            "--system",
            "truth",
            "optimal_calibration" if new else "truth",
            "--recordings",
            "all",
        ]
    ),
    "train": Job(_train, resumes=True),
}
_OUT_OPTION = {"evaluate": "--plots"}
_OUT_NAME = {"rectify": "out/picture.png"}
_NO_OVERWRITE = ("evaluate",)


def command_of(name: str, root: Path, out: Path, *, new: bool) -> list[str]:
    """Return a command with its output, for newer or older results."""
    place = out / Path(_OUT_NAME[name]).name if name in _OUT_NAME else out
    options: list[object] = [_OUT_OPTION.get(name, "--out"), place]
    options += [] if name in _NO_OVERWRITE else ["--overwrite"]
    return [str(argument) for argument in [*JOBS[name].arguments(root, new), *options]]


def input_commands(root: Path) -> list[list[str]]:
    """Return the commands that make what the others read, in a folder."""
    shards = ["bcs-masks", _session(root), "--masks", _masks(root), "--size", "160x96", "--min-height", 3]
    commands: list[list[object]] = [
        ["synth", "session", "--size", _SIZE, "--duration", _SECONDS, "--traffic", 60, "--out", root / "data"],
        ["synth", "boxcars", "--vehicles", 4, "--seed", 3, "--out", root / "tree"],
        [*shards, "--every", 5, "--out", root / "shards"],
        [*shards, "--every", 7, "--out", root / "exact"],
        [*_train(root, new=False), "--out", root / "run"],
    ]
    return [[str(argument) for argument in command] for command in commands]
