"""Damaged and hostile files of every kind that labelgen reads, each through a public command in a process of its own.

    python -m tools.studies.fuzz --count 2000 --seed 0

A case takes a good file, changes it by a seeded rule, and runs a command on it. Right is exit code 0, or 2 with a
reason in one line. Wrong are tracebacks, ends by a signal, more than 20 s, and more than 1 GB of memory beyond that of
the imports. Cases that fail are listed with their seed; `--only CLASS:NUMBER` runs one again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import pickle
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch

from detector.checkpoint import ModelMetadata
from detector.model.retinanet import ModelConfig, build_model
from labelgen.cli.main import main as run_command
from labelgen.geometry import Camera, Pair, road_cuboids
from tools.benchmarks.score import synthetic_recording

__all__ = ["CLASSES", "Failure", "fuzz"]

_FRAME_WH = (320, 180)
_CAMERA = Camera(np.array([-66.5, -83.5]), np.array([1216.5, -150.0]), np.array([160.0, 90.0]), 0.12, _FRAME_WH, "road")
_ROAD_M = np.array([[20.0, -4.0], [20.0, -22.0], [70.0, -22.0], [70.0, -4.0]])
_FRAMES = 8
_SECONDS, _MEMORY = 20, 1_000_000_000

Rng = np.random.Generator
Case = tuple[Sequence[object], str]
"""Arguments of the command, and what was changed."""


@dataclass(frozen=True)
class Failure:
    """A case that went wrong.

    Args:
        name: class and number of the case.
        change: what was changed.
        arguments: of the command.
        problem: what went wrong.
        output: end of what the command printed.
    """

    name: str
    change: str
    arguments: str
    problem: str
    output: str


# -- good files ---------------------------------------------------------------------------------------------


def _make_good_files(root: Path) -> None:
    """Write one good file of each kind."""
    rng = np.random.default_rng(0)
    frames = root / "road"
    frames.mkdir(parents=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    ground = cv2.resize(rng.integers(90, 130, (45, 80, 3), dtype=np.uint8), _FRAME_WH)
    for n in range(_FRAMES):
        picture = ground.copy()
        images.append({"id": n, "file_name": f"{n:03d}.png", "width": _FRAME_WH[0], "height": _FRAME_WH[1]})
        x = 36.0 - 1.2 * n
        near = np.array([[x, -9.0], [x + 5.0, -15.0]])
        boxes = _CAMERA.project(road_cuboids(near, np.array([[4.4, 1.8, 1.5], [5.2, 2.0, 2.1]])))
        for vertices in boxes:
            hull = cv2.convexHull(vertices.astype(np.float32))[:, 0]
            cv2.fillConvexPoly(picture, np.round(hull).astype(np.int32), (30, 60, 200))
            segmentation = [np.round(hull, 2).ravel().tolist()]
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": n,
                    "category_id": 3,
                    "segmentation": segmentation,
                    "score": 0.9,
                }
            )
        cv2.imwrite(str(frames / f"{n:03d}.png"), picture)
    coco = {"images": images, "annotations": annotations, "categories": [{"id": 3, "name": "car"}]}
    (root / "masks.json").write_text(json.dumps(coco))
    (root / "road.calibration.json").write_text(json.dumps(_CAMERA.to_dict()))
    mask = np.zeros(_FRAME_WH[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round(_CAMERA.project(_ROAD_M)).astype(np.int32), 255)
    cv2.imwrite(str(root / "road.mask.png"), mask)
    _run_good(*_bcs(root, root / "shards"))
    _run_good(
        "speed", root / "road", "--from", f"masks:coco:{root / 'masks.json'}", "--fps", 10, *_scene(root),
        "--out", root / "speeds",
    )  # fmt: skip
    _make_tree(root / "tree", rng)
    _make_checkpoint(root / "last.ckpt")
    recording = synthetic_recording(6, 1)
    for name in ("dataset", "results"):
        (root / name / "session4_left").mkdir(parents=True)
    (root / "dataset" / "session4_left" / "gt_data.pkl").write_bytes(pickle.dumps(recording.truth, protocol=2))
    (root / "results" / "session4_left" / "system_a.json").write_text(json.dumps(recording.results))


def _run_good(*arguments: object) -> None:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            run_command([str(argument) for argument in arguments])
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{arguments}: {printed.getvalue()}") from None


def _scene(root: Path, **other: Path) -> list[object]:
    return [
        "--calibration", other.get("calibration", root / "road.calibration.json"),
        "--road-mask", other.get("mask", root / "road.mask.png"),
    ]  # fmt: skip


def _bcs(root: Path, out: Path, **other: Path) -> list[object]:
    masks = f"coco:{other.get('masks', root / 'masks.json')}"
    frames = other.get("frames", root / "road")
    return [
        "bcs-masks",
        frames,
        "--masks",
        masks,
        "--every",
        2,
        "--size",
        "160x96",
        "--out",
        out,
        *_scene(root, **other),
    ]


def _make_tree(root: Path, rng: Rng) -> None:
    near = np.array([[30.0, -9.0]])
    vertices = _CAMERA.project(road_cuboids(near, np.array([[4.4, 1.8, 1.5]])))[0]
    low, high = np.floor(vertices.min(0)) - 8, np.ceil(vertices.max(0)) + 8
    crop = rng.integers(0, 255, (int(high[1] - low[1]), int(high[0] - low[0]), 3), dtype=np.uint8)
    (root / "images").mkdir(parents=True)
    instances = []
    for i in range(3):
        cv2.imwrite(str(root / "images" / f"{i}.png"), crop)
        instances.append(
            {"2DBB": np.zeros(4), "3DBB": vertices, "3DBB_offset": low, "instance_id": i, "path": f"{i}.png"}
        )
    camera = {key: getattr(_CAMERA, key) for key in ("vp1", "vp2", "vp3", "pp")}
    sample = {"camera": "uvoz", "to_camera": True, "annotation": "a car", "instances": instances}
    (root / "dataset.pkl").write_bytes(pickle.dumps({"cameras": {"uvoz": camera}, "samples": [sample]}, protocol=2))


def _make_checkpoint(path: Path) -> None:
    config = ModelConfig(
        backbone="resnet18", levels=(3, 4, 5), channels=16, head_convs=1, head_norm="group",
        anchor_sizes=((16.0,), (32.0,), (64.0,)), anchor_ratios=(1.0,),
    )  # fmt: skip
    torch.manual_seed(0)
    state = {f"model.{key}": value for key, value in build_model(config).state_dict().items()}
    labels = [{"samples": 1, "weight": 1.0, "producers": [], "settings": [{"kind": "masks"}], "sha256": []}]
    metadata = ModelMetadata("small", Pair.VP2_VP3, (160, 96), config, 0.0, labels, {"seed": 0})
    torch.save({"state_dict": state, "labelgen": metadata.to_dict(), "epoch": 0, "global_step": 1}, path)


# -- changes ------------------------------------------------------------------------------------------------

_LONG, _DEEP, _WIDE = "x" * 100_000, 5_000, 200_000


def _strange_value(rng: Rng) -> Any:
    """Return a value that is seldom what is expected."""
    deep: Any = 1
    for _ in range(60):
        deep = [deep]
    values: list[Any] = [
        None, True, False, 0, -1, 1, 2**31, 2**63, -(2**63), 10**400, 0.5, -0.5, 1e308, -1e308, 1e-320, float("nan"),
        float("inf"), float("-inf"), "", "x", "1", "NaN", "\0", "../../etc/passwd", "/dev/zero", "=1+1", "\x1b[2J", "é",
        "\ud800", _LONG, [], [[]], [None], [1, 2], [1.0] * 5000, ["a", "b"], {}, {"a": 1}, {"": None}, deep,
    ]  # fmt: skip
    return values[rng.integers(len(values))]


def _places(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to every value inside another one."""
    if way:
        yield way
    parts: Any = ()
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list | tuple):
        parts = list(enumerate(value))[:20]
    for key, part in parts:
        yield from _places(part, (*way, key))


def _change_value(rng: Rng, data: Any, strange: Callable[[Rng], Any] = _strange_value) -> str:
    """Change a value inside another one, in place."""
    ways = [way for way in _places(data) if not isinstance(_at(data, way[:-1]), tuple)]
    *way, key = ways[rng.integers(len(ways))]
    holder = _at(data, way)
    kind = rng.integers(5)
    if kind == 0:
        if isinstance(holder, dict):
            del holder[key]
        else:
            holder.pop(key)
        return f"{[*way, key]} removed"
    if kind == 1 and isinstance(holder[key], list) and holder[key]:
        holder[key] = holder[key] * int(rng.integers(2, 50))
        return f"{[*way, key]} repeated"
    if kind == 2 and isinstance(holder[key], int | float):
        holder[key] = holder[key] * float(10.0 ** rng.integers(-12, 40))
        return f"{[*way, key]} = {holder[key]}"
    holder[key] = strange(rng)
    return f"{[*way, key]} = {repr(holder[key])[:60]}"


def _at(data: Any, way: Sequence[Any]) -> Any:
    for key in way:
        data = data[key]
    return data


def _change_bytes(rng: Rng, data: bytes) -> tuple[bytes, str]:
    """Flip, cut, insert, repeat or overwrite bytes."""
    content = bytearray(data)
    kind = int(rng.integers(6))
    at = int(rng.integers(len(content)))
    if kind == 0:
        for _ in range(int(rng.integers(1, 20))):
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del content[at:]
    elif kind == 2:
        content[at:at] = rng.bytes(int(rng.integers(1, 200)))
    elif kind == 3:
        content[at : at + int(rng.integers(1, 64))] = b"\xff" * int(rng.integers(1, 64))
    elif kind == 4:
        del content[at : at + int(rng.integers(1, 200))]
    else:
        content += content[at:]
    return bytes(content), ("flip", "cut", "insert", "overwrite", "remove", "repeat")[kind]


def _change_json(rng: Rng, text: str) -> tuple[bytes, str]:
    """Change JSON text: a value, its bytes, or all of it."""
    kind = int(rng.integers(10))
    if kind == 0:
        return _change_bytes(rng, text.encode())
    if kind == 1:
        whole: list[tuple[bytes, str]] = [
            (b"", "empty"), (b"[" * 100_000, "deep"), (b'{"a":' * 100_000, "deep objects"), (b"\xff" * 9, "no text"),
            (b"[" + b"{}," * _WIDE + b"{}]", "very many empty objects"), (b"9" * 100_000, "long"),
            (b'"' + b"x" * 1_000_000 + b'"', "a long text"), (b"null", "null"), (text.encode("utf-16"), "UTF-16"),
        ]  # fmt: skip
        return whole[rng.integers(len(whole))]
    data = json.loads(text)
    changes = [_change_value(rng, data) for _ in range(int(rng.integers(1, 4)))]
    return json.dumps(data).encode("utf-8", "surrogatepass"), "; ".join(changes)


# -- classes ------------------------------------------------------------------------------------------------


def _shards(rng: Rng, good: Path, work: Path) -> Case:
    folder = work / "set"
    shutil.copytree(good / "shards", folder)
    path = folder / "shard-00000.h5"
    if rng.random() < 0.5:
        (folder / "dataset.json").unlink()
    if rng.random() < 0.25:
        content, change = _change_bytes(rng, path.read_bytes())
        path.write_bytes(content)
    else:
        with h5py.File(path, "r+") as file:
            change = _change_hdf5(rng, file, work)
    command = ("inspect", "validate", "merge", "audit", "test-detector", "detect")[rng.integers(6)]
    arguments: list[object] = [command, folder]
    if command in ("merge", "audit"):
        arguments += ["--out", work / "out"]
    elif command in ("test-detector", "detect"):
        arguments = [command, good / "last.ckpt", folder, "--device", "cpu"]
        arguments += ["--out", work / "out"] if command == "detect" else []
    return arguments, change


def _change_hdf5(rng: Rng, file: h5py.File, work: Path) -> str:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    name, kind = names[rng.integers(len(names))], int(rng.integers(14))
    dataset = file[name]
    shape, dtype, text = dataset.shape, dataset.dtype, h5py.check_string_dtype(dataset.dtype) is not None
    if kind < 4:
        key = list(file.attrs)[rng.integers(len(file.attrs))]
        if kind == 0:
            del file.attrs[key]
            return f"attribute {key} removed"
        value = _strange_value(rng)
        with contextlib.suppress(Exception):
            del file.attrs[key]
            file.attrs[key] = json.dumps(value) if kind == 1 else value
        return f"attribute {key} = {repr(value)[:60]}"
    if kind < 8 and dataset.size and not text:
        index = tuple(int(rng.integers(n)) for n in shape)
        values = [0, 1, 255, -1, 2**31 - 1, 2**63 - 1, 1e30, -1e30, np.nan, np.inf, 0.5]
        value = values[rng.integers(len(values))]
        with contextlib.suppress(OverflowError, ValueError, TypeError):
            dataset[index] = value
        return f"{name}{index} = {value}"
    del file[name]
    (work / "secret.txt").write_bytes(b"secret" * 1000)
    size = max(1, int(np.prod(shape)))
    with contextlib.suppress(Exception):
        if kind == 8:
            file.create_dataset(name, shape=(4_000_000_000, *shape[1:]), dtype=dtype, fillvalue=None if text else 1)
        elif kind == 9:
            file.create_dataset(name, shape=shape, dtype="u1", external=[(str(work / "secret.txt"), 0, size)])
        elif kind == 10:
            file[name] = h5py.ExternalLink("/etc/hostname", "x") if rng.random() < 0.5 else h5py.SoftLink("/images")
        elif kind == 11:
            file.create_dataset(name, data=[h5py.Empty("f4"), np.float32(1), "text", ["a"] * 3][rng.integers(4)])
        elif kind == 12:
            other = ("f8", "i2", "S3", "c16", "?")[rng.integers(5)]
            file.create_dataset(name, data=np.zeros(shape, other))
        elif kind == 13:
            os.mkfifo(work / "pipe")
            layout = h5py.VirtualLayout(shape=(size,), dtype="u1")
            layout[:] = h5py.VirtualSource(str(work / "pipe"), "x", shape=(size,))
            file.create_virtual_dataset(name, layout)
    return f"{name} replaced, kind {kind}"


def _indexes(rng: Rng, good: Path, work: Path) -> Case:
    folder = work / "set"
    shutil.copytree(good / "shards", folder)
    name = "dataset.json" if rng.random() < 0.8 else "rejects.jsonl"
    text = (folder / name).read_text()
    content, change = _change_json(rng, text) if name == "dataset.json" else _change_bytes(rng, text.encode() or b" ")
    (folder / name).write_bytes(content)
    if rng.random() < 0.2:
        staged = folder / ".labelgen-job"
        staged.mkdir()
        for path in folder.iterdir():
            if path.is_file() and path.name != "dataset.json":
                shutil.copy(path, staged / path.name)
        shutil.move(folder / "dataset.json", staged / "dataset.json")
        (staged / "job.json").write_text("{}")
        return [*_bcs(good, folder), *(["--overwrite"] if rng.random() < 0.5 else [])], f"staged index: {change}"
    command = ("inspect", "validate", "merge", "audit")[rng.integers(4)]
    return [command, folder, *(["--out", work / "out"] if command in ("merge", "audit") else [])], change


def _checkpoints(rng: Rng, good: Path, work: Path) -> Case:
    path = work / "bad.ckpt"
    kind = int(rng.integers(8))
    if kind == 0:
        content, change = _change_bytes(rng, (good / "last.ckpt").read_bytes())
        path.write_bytes(content)
    elif kind == 1:
        content, change = _change_pickle_in_zip(rng, good / "last.ckpt", path)
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
            change = _change_value(rng, part, _strange_setting)
        torch.save(data, path)
    command = ("detect", "test-detector", "export-model", "weights", "speed")[rng.integers(5)]
    out, cpu = ["--out", work / "out"], ["--device", "cpu"]
    arguments: dict[str, list[object]] = {
        "detect": ["detect", path, good / "shards", "--device", "cpu", *out],
        "test-detector": ["test-detector", path, good / "shards", "--device", "cpu"],
        "export-model": ["export-model", path, "--out", work / "out.onnx"],
        "weights": ["bcs-masks", good / "road", "--masks", "maskrcnn", "--weights", path, *cpu, *_scene(good), *out],
        "speed": ["speed", good / "road", "--from", f"model:{path}", "--fps", 10, *cpu, *_scene(good), *out],
    }  # fmt: skip
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
    return names[rng.integers(len(names))] if rng.random() < 0.4 else _strange_value(rng)


def _change_pickle_in_zip(rng: Rng, source: Path, target: Path) -> tuple[bytes, str]:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        change = ""
        for info in old.infolist():
            content = old.read(info)
            if info.filename.endswith("data.pkl"):
                content, change = _change_pickle(rng, content)
            new.writestr(info, content)
    return b"", change


def _change_pickle(rng: Rng, content: bytes) -> tuple[bytes, str]:
    """Change a pickle: its bytes, or to a program that costs much."""
    programs: list[tuple[bytes, str]] = [
        (b"\x80\x02Nr\xff\xff\xff\x7f.", "huge memo"),
        (b"\x80\x02}K\x01" + b"\x85" * 300_000 + b"Ns.", "deep key"),
        (
            b"\x80\x02}K\x01q\x00" + b"".join(b"0h%ch%c\x86q%c" % (i, i, i + 1) for i in range(60)) + b"Ns.",
            "doubled key",
        ),
        (b"\x80\x02](" + b"}" * 3_000_000 + b"e.", "many objects"),
        (b"\x80\x02" + b"]" * 300_000 + b"a" * 299_999 + b".", "deep lists"),
        (b"cos\nsystem\n(S'true'\ntR.", "a call"),
        (b"\x80\x02]q\x00h\x00a.", "a list in itself"),
        (b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.", "huge frame"),
        (b"", "empty"),
    ]
    if rng.random() < 0.4:
        return programs[rng.integers(len(programs))]
    return _change_bytes(rng, content)


def _pickles(rng: Rng, good: Path, work: Path) -> Case:
    tree = work / "tree"
    shutil.copytree(good / "tree", tree)
    path = tree / "dataset.pkl"
    if rng.random() < 0.5:
        content, change = _change_pickle(rng, path.read_bytes())
    else:
        data = pickle.loads(path.read_bytes())
        change = _change_value(rng, data)
        content = pickle.dumps(data, protocol=int(rng.integers(0, 5)))
    path.write_bytes(content)
    return ["boxcars", "--root", tree, "--out", work / "out", "--cameras", "all", "--all-directions"], change


def _coco(rng: Rng, good: Path, work: Path) -> Case:
    content, change = _change_json(rng, (good / "masks.json").read_text())
    (work / "masks.json").write_bytes(content)
    return _bcs(good, work / "out", masks=work / "masks.json"), change


def _calibrations(rng: Rng, good: Path, work: Path) -> Case:
    content, change = _change_json(rng, (good / "road.calibration.json").read_text())
    path = work / "calibration.json"
    path.write_bytes(content)
    if rng.random() < 0.5:
        scene = _scene(good, calibration=path)
        return ["rectify", good / "road", "--out", work / "out.png", *scene], change
    return _bcs(good, work / "out", calibration=path), change


def _detections(rng: Rng, good: Path, work: Path) -> Case:
    source = next((good / "speeds").rglob("detections_*.jsonl"))
    lines = source.read_text().splitlines()
    number = int(rng.integers(len(lines)))
    kind = rng.random()
    if kind < 0.2:
        content, change = _change_bytes(rng, source.read_bytes())
    else:
        changed, change = _change_json(rng, lines[number])
        content = b"\n".join(
            [*(line.encode() for line in lines[:number]), changed, *(t.encode() for t in lines[number + 1 :])]
        )
        change = f"line {number}: {change}"
    path = work / "detections.jsonl"
    path.write_bytes(content)
    return [
        "speed", good / "road", "--from", f"detections:{path}", "--fps", 10, *_scene(good), "--out", work / "out",
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
        content, change = _change_json(rng, results.read_text())
        results.write_bytes(content)
    elif kind < 0.6:
        content, change = _change_pickle(rng, truth.read_bytes())
        truth.write_bytes(content)
    else:
        data = pickle.loads(truth.read_bytes())
        change = _change_value(rng, data)
        truth.write_bytes(pickle.dumps(data, protocol=2))
    return [
        "evaluate", "--dataset", work / "dataset", "--results", work / "results", "--system", "a",
        "--recordings", "all",
    ], change  # fmt: skip


def _changed_picture(rng: Rng, path: Path) -> tuple[bytes, str]:
    kind = int(rng.integers(6))
    if kind == 0:
        width, height = (int(n) for n in rng.choice([1, 20_000, 60_000, 2**31 - 1], 2))
        content = bytearray(path.read_bytes())
        content[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
        return bytes(content), f"announces {width}x{height}"
    if kind == 1:
        return b"P5\n40000 40000\n255\n" + bytes(1000), "a large PGM"
    if kind == 2:
        encoded = cv2.imencode(".jpg", np.zeros((10, 10, 3), np.uint8))[1].tobytes()
        return _change_bytes(rng, encoded)
    if kind == 3:
        shape = [(1, 1), (1, 5000), (3000, 3000), (181, 320)][rng.integers(4)]
        return cv2.imencode(".png", np.full(shape, 255, np.uint8))[1].tobytes(), f"of {shape}"
    return _change_bytes(rng, path.read_bytes())


def _masks(rng: Rng, good: Path, work: Path) -> Case:
    path = work / "mask.png"
    content, change = _changed_picture(rng, good / "road.mask.png")
    path.write_bytes(content)
    if rng.random() < 0.5:
        return ["rectify", good / "road", "--out", work / "out.png", *_scene(good, mask=path)], change
    return _bcs(good, work / "out", mask=path), change


def _folders(rng: Rng, good: Path, work: Path) -> Case:
    frames = work / "road"
    shutil.copytree(good / "road", frames)
    changes = []
    for _ in range(int(rng.integers(1, 4))):
        path = frames / f"{int(rng.integers(_FRAMES)):03d}.png"
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
            content, change = _changed_picture(rng, path)
            path.write_bytes(content)
        changes.append(f"{path.name}: {change}")
    return _bcs(good, work / "out", frames=frames), "; ".join(changes)


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
}
"""Makers of cases by the kind of file: each writes a changed file and returns the command that reads it."""


# -- running ------------------------------------------------------------------------------------------------


def fuzz(
    count: int, seed: int, *, classes: Sequence[str] = (), only: tuple[str, int] | None = None, keep: Path | None = None
) -> tuple[Counter[str], list[Failure]]:
    """Run cases.

    Args:
        count: number of cases, spread over the classes.
        seed: decides all changes.
        classes: names of the classes; all where empty.
        only: class and number of one case.
        keep: folder for its files.

    Returns:
        numbers of cases by class and outcome, and those that went wrong.
    """
    names = list(classes or CLASSES)
    outcomes: Counter[str] = Counter()
    failures: list[Failure] = []
    with tempfile.TemporaryDirectory() as folder:
        good = Path(folder) / "good"
        _make_good_files(good)
        for number in range(count) if only is None else [only[1]]:
            name = names[number % len(names)] if only is None else only[0]
            work = keep or Path(folder) / "work"
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            rng = np.random.default_rng([seed, number])
            arguments, change = CLASSES[name](rng, good, work)
            problem, output = _run_case([str(argument) for argument in arguments], work)
            outcomes[f"{name}: {problem if problem in _RIGHT else 'wrong'}"] += 1
            if problem not in _RIGHT:
                shown = " ".join(map(str, arguments)).encode("utf-8", "backslashreplace").decode()
                failures.append(Failure(f"{name}:{number}", change, shown, problem, output[-3000:]))
    return outcomes, failures


_RIGHT = ("done", "refused")


def _run_case(arguments: list[str], work: Path) -> tuple[str, str]:
    """Run a command in a child with bounds of time and memory; return the outcome and what it printed."""
    output = work / "output.txt"
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        _be_child(arguments, output)
    end = time.monotonic() + _SECONDS
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"more than {_SECONDS} s", output.read_text(errors="replace")
        time.sleep(0.01)
    printed = output.read_text(errors="replace")
    if os.WIFSIGNALED(status):
        return f"ended by signal {os.WTERMSIG(status)}", printed
    code = os.WEXITSTATUS(status)
    if "Traceback (most recent call last)" in printed:
        return "a traceback", printed
    if re.search(r"MemoryError|[Uu]nable to allocate|bad_alloc|Insufficient memory|can't allocate memory", printed):
        return "out of memory", printed
    if code == 0:
        return "done", printed
    if code == 2 and "labelgen: error: " in printed:
        return "refused", printed
    return f"exit code {code}", printed


def _be_child(arguments: list[str], output: Path) -> None:
    """Run the command in this process, which then ends."""
    code = 70
    try:
        os.setsid()
        handle = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout = open(1, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        with contextlib.suppress(OSError):
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))
        try:
            run_command(arguments)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        sys.stdout.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def main() -> None:
    """Parse the options, run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="decides all changes")
    parser.add_argument(
        "--classes", nargs="*", default=[], choices=list(CLASSES), help="kinds of files; all by default"
    )
    parser.add_argument("--only", metavar="CLASS:NUMBER", help="run one case again")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep its files here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    name, _, number = (options.only or "").partition(":")
    only = (name, int(number)) if options.only else None
    outcomes, failures = fuzz(options.count, options.seed, classes=options.classes, only=only, keep=options.keep)
    for key, value in sorted(outcomes.items()):
        print(f"  {key:<28} {value}")
    for failure in failures:
        print(f"\n{failure.name}: {failure.problem}\n  {failure.change}\n  labelgen {failure.arguments}")
        print("\n".join(f"    {line}" for line in failure.output.splitlines()[-14:]))
    print(f"\n{sum(outcomes.values())} cases, {len(failures)} wrong")
    raise SystemExit(1 if failures else 0)


if __name__ == "__main__":
    main()
