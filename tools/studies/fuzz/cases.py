"""Makers of cases: each writes a changed file and returns the command that reads it."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import torch

from tools.studies.fuzz.changes import (
    change_bytes,
    change_hdf5,
    change_json,
    change_pickle,
    change_pickle_in_zip,
    change_value,
    changed_picture,
    strange_value,
)
from tools.studies.fuzz.command_cases import options_case
from tools.studies.fuzz.good_files import FRAMES, SHORT_TRAINING, Case, Rng, bcs_masks, scene_options
from tools.studies.fuzz.video_cases import streams_case, videos_case

__all__ = ["CLASSES"]


def _shards(rng: Rng, good: Path, work: Path) -> Case:
    folder = work / "set"
    shutil.copytree(good / "shards", folder)
    path = folder / "shard-00000.h5"
    if rng.random() < 0.5:
        (folder / "dataset.json").unlink()
    if rng.random() < 0.25:
        content, change = change_bytes(rng, path.read_bytes())
        path.write_bytes(content)
    else:
        with h5py.File(path, "r+") as file:
            change = change_hdf5(rng, file, work)
    command = ("inspect", "validate", "merge", "audit", "test-detector", "detect", "train")[rng.integers(7)]
    arguments: list[object] = [command, folder]
    if command in ("merge", "audit"):
        arguments += ["--out", work / "out"]
    elif command in ("test-detector", "detect"):
        arguments = [command, good / "last.ckpt", folder, "--device", "cpu"]
        arguments += ["--out", work / "out"] if command == "detect" else []
    elif command == "train":
        arguments += [*SHORT_TRAINING, "--out", work / "out"]
    return arguments, change


def _indexes(rng: Rng, good: Path, work: Path) -> Case:
    folder = work / "set"
    shutil.copytree(good / "shards", folder)
    name = "dataset.json" if rng.random() < 0.8 else "rejects.jsonl"
    text = (folder / name).read_text()
    content, change = change_json(rng, text) if name == "dataset.json" else change_bytes(rng, text.encode() or b" ")
    (folder / name).write_bytes(content)
    if rng.random() < 0.2:
        staged = folder / ".labelgen-job"
        staged.mkdir()
        for path in folder.iterdir():
            if path.is_file() and path.name != "dataset.json":
                shutil.copy(path, staged / path.name)
        shutil.move(folder / "dataset.json", staged / "dataset.json")
        (staged / "job.json").write_text("{}")
        return [*bcs_masks(good, folder), *(["--overwrite"] if rng.random() < 0.5 else [])], f"staged index: {change}"
    command = ("inspect", "validate", "merge", "audit")[rng.integers(4)]
    return [command, folder, *(["--out", work / "out"] if command in ("merge", "audit") else [])], change


def _checkpoints(rng: Rng, good: Path, work: Path) -> Case:
    path = work / "bad.ckpt"
    kind = int(rng.integers(8))
    if kind == 0:
        content, change = change_bytes(rng, (good / "last.ckpt").read_bytes())
        path.write_bytes(content)
    elif kind == 1:
        content, change = change_pickle_in_zip(rng, good / "last.ckpt", path)
    elif kind == 2:
        change = "other content"
        other: list[Any] = [[], {}, {"labelgen": {}}, torch.zeros(3), {"state_dict": [], "labelgen": 1}, "text"]
        torch.save(other[rng.integers(len(other))], path)
    else:
        data = torch.load(good / "last.ckpt", weights_only=True)
        if kind == 3:
            key = list(data["state_dict"])[rng.integers(len(data["state_dict"]))]
            values: list[Any] = [
                torch.zeros(1), torch.zeros(1).expand(10**9), torch.full_like(data["state_dict"][key], 1).double() / 0,
                None, "x", torch.zeros(3, 3).to_sparse(), torch.zeros(2, dtype=torch.complex64),
            ]  # fmt: skip
            data["state_dict"][key] = values[rng.integers(len(values))]
            change = f"weight {key}"
        else:
            data["labelgen"]["config"] = {k: _listed(v) for k, v in data["labelgen"]["config"].items()}
            part = data["labelgen"] if kind < 6 else data["labelgen"]["config"]
            change = change_value(rng, part, _strange_setting)
        torch.save(data, path)
    command = ("detect", "test-detector", "export-model", "weights", "speed", "resume")[rng.integers(6)]
    out, cpu, scene = ["--out", work / "out"], ["--device", "cpu"], scene_options(good)
    arguments: dict[str, list[object]] = {
        "detect": ["detect", path, good / "shards", "--device", "cpu", *out],
        "test-detector": ["test-detector", path, good / "shards", "--device", "cpu"],
        "export-model": ["export-model", path, "--out", work / "out.onnx"],
        "weights": ["bcs-masks", good / "road", "--masks", "maskrcnn", "--weights", path, *cpu, *scene, *out],
        "speed": ["speed", good / "road", "--from", f"model:{path}", "--fps", 10, *cpu, *scene, *out],
        "resume": ["train", good / "shards", *SHORT_TRAINING, "--epochs", 2, "--resume", "--out", work / "run"],
    }  # fmt: skip
    if command == "resume":
        shutil.copytree(good / "run", work / "run")
        shutil.move(path, work / "run" / "last.ckpt")
    return arguments[command], change


def _listed(value: Any) -> Any:
    return [_listed(v) for v in value] if isinstance(value, list | tuple) else value


def _strange_setting(rng: Rng) -> Any:
    names = [
        "vit_h_14",
        "fasterrcnn_resnet50_fpn",
        "raft_large",
        "resnet152",
        "group",
        "frozen",
        "VP1-VP2",
        10**9,
        4097,
    ]
    return names[rng.integers(len(names))] if rng.random() < 0.4 else strange_value(rng)


def _pickles(rng: Rng, good: Path, work: Path) -> Case:
    tree = work / "tree"
    shutil.copytree(good / "tree", tree)
    path = tree / "dataset.pkl"
    if rng.random() < 0.5:
        content, change = change_pickle(rng, path.read_bytes())
    else:
        data = pickle.loads(path.read_bytes())
        change = change_value(rng, data)
        content = pickle.dumps(data, protocol=int(rng.integers(0, 5)))
    path.write_bytes(content)
    return ["boxcars", "--root", tree, "--out", work / "out", "--cameras", "all", "--all-directions"], change


def _coco(rng: Rng, good: Path, work: Path) -> Case:
    content, change = change_json(rng, (good / "masks.json").read_text())
    (work / "masks.json").write_bytes(content)
    return bcs_masks(good, work / "out", masks=work / "masks.json"), change


def _calibrations(rng: Rng, good: Path, work: Path) -> Case:
    content, change = change_json(rng, (good / "road.calibration.json").read_text())
    path = work / "calibration.json"
    path.write_bytes(content)
    if rng.random() < 0.5:
        scene = scene_options(good, calibration=path)
        return ["rectify", good / "road", "--out", work / "out.png", *scene], change
    return bcs_masks(good, work / "out", calibration=path), change


def _detections(rng: Rng, good: Path, work: Path) -> Case:
    source = next((good / "speeds").rglob("detections_*.jsonl"))
    lines = source.read_text().splitlines()
    number = int(rng.integers(len(lines)))
    kind = rng.random()
    if kind < 0.2:
        content, change = change_bytes(rng, source.read_bytes())
    else:
        changed, change = change_json(rng, lines[number])
        content = b"\n".join(
            [*(line.encode() for line in lines[:number]), changed, *(t.encode() for t in lines[number + 1 :])]
        )
        change = f"line {number}: {change}"
    path = work / "detections.jsonl"
    path.write_bytes(content)
    return [
        "speed", good / "road", "--from", f"detections:{path}", "--fps", 10, *scene_options(good),
        "--out", work / "out",
    ], change  # fmt: skip


def _truths(rng: Rng, good: Path, work: Path) -> Case:
    for name in ("dataset", "results"):
        shutil.copytree(good / name, work / name)
    truth, results = (
        work / "dataset" / "session4_left" / "gt_data.pkl",
        work / "results" / "session4_left" / "system_a.json",
    )
    kind = rng.random()
    if kind < 0.4:
        content, change = change_json(rng, results.read_text())
        results.write_bytes(content)
    elif kind < 0.6:
        content, change = change_pickle(rng, truth.read_bytes())
        truth.write_bytes(content)
    else:
        data = pickle.loads(truth.read_bytes())
        change = change_value(rng, data)
        truth.write_bytes(pickle.dumps(data, protocol=2))
    return [
        "evaluate", "--dataset", work / "dataset", "--results", work / "results", "--system", "a",
        "--recordings", "all",
    ], change  # fmt: skip


def _masks(rng: Rng, good: Path, work: Path) -> Case:
    path = work / "mask.png"
    content, change = changed_picture(rng, good / "road.mask.png")
    path.write_bytes(content)
    if rng.random() < 0.5:
        return ["rectify", good / "road", "--out", work / "out.png", *scene_options(good, mask=path)], change
    return bcs_masks(good, work / "out", mask=path), change


def _folders(rng: Rng, good: Path, work: Path) -> Case:
    frames = work / "road"
    shutil.copytree(good / "road", frames)
    changes = []
    for _ in range(int(rng.integers(1, 4))):
        path = frames / f"{int(rng.integers(FRAMES)):03d}.png"
        kind = int(rng.integers(5))
        if path.is_symlink() or not path.is_file():
            continue
        if kind == 0:
            path.unlink()
            os.mkfifo(path)
            change = "a pipe"
        elif kind == 1:
            path.unlink()
            path.symlink_to(("/dev/zero", "nowhere", str(path), "/")[rng.integers(4)])
            change = "a link"
        elif kind == 2:
            os.rename(
                path, os.fsencode(frames) + (b"/\xff.png", b"/\n.png", b"/\x1b[2J.png", b"/-1.png")[rng.integers(4)]
            )
            change = "an odd name"
        else:
            content, change = changed_picture(rng, path)
            path.write_bytes(content)
        changes.append(f"{path.name}: {change}")
    return bcs_masks(good, work / "out", frames=frames), "; ".join(changes)


CLASSES: dict[str, Callable[[Rng, Path, Path], Case]] = {
    "shards": _shards,
    "indexes": _indexes,
    "checkpoints": _checkpoints,
    "pickles": _pickles,
    "coco": _coco,
    "detections": _detections,
    "calibrations": _calibrations,
    "truths": _truths,
    "masks": _masks,
    "folders": _folders,
    "videos": videos_case,
    "streams": streams_case,
    "options": options_case,
}
"""Makers of cases by the kind of input: each writes a changed file and returns the command that reads it."""
