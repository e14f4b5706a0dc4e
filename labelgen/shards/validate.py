"""Validation of shards: the rules of the format, all values and images, and the content hash."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError, LabelgenError
from labelgen.geometry.box_codec import decode_boxes
from labelgen.labels import Flag, Split, VehicleClass
from labelgen.shards.dataset import find_shards
from labelgen.shards.index import INDEX_NAME, REJECTS_NAME, build_index, file_hash, read_index
from labelgen.shards.reader import ShardReader
from labelgen.shards.schema import FIELDS, HASH_ATTRIBUTE, TEXT, content_hash

__all__ = ["content_is_intact", "validate_folder", "validate_shard", "validate_shards"]

_UNREADABLE = (OSError, RuntimeError, LookupError, TypeError, ValueError, MemoryError, OverflowError)


def validate_shards(paths: Sequence[str | Path]) -> dict[Path, list[str]]:
    """Return the problems of shards and folders, by path; an empty list where there are none.

    Args:
        paths: shards and folders; folders are compared with their index as well.

    Raises:
        DataError: a path does not exist, or a folder holds no shards.
    """
    problems: dict[Path, list[str]] = {}
    for path in map(Path, paths):
        if path.is_dir():
            try:
                problems[path] = validate_folder(path)
            except DataError as err:
                problems[path] = [str(err)]
    for shard in find_shards(paths):
        # HDF5 itself may crash on a changed file: files that differ from their index are not opened.
        if not any(problem.startswith(f"{shard.name}: ") for problem in problems.get(shard.parent, [])):
            problems[shard] = validate_shard(shard)
    return problems


def validate_folder(folder: Path) -> list[str]:
    """Return the differences between a folder's shards and its index and rejects file.

    Raises:
        DataError: the index is missing or damaged.
    """
    index = read_index(folder)
    names = [str(entry["name"]) for entry in index["shards"]]
    present = {path.name: path for path in folder.glob("shard-*.h5")}
    problems = [f"{name}: named in {INDEX_NAME} but missing" for name in names if name not in present]
    problems += [f"{name}: not named in {INDEX_NAME}" for name in sorted(present) if name not in names]
    for entry in index["shards"]:
        path = present.get(entry["name"])
        if path is not None and file_hash(path) != entry.get("file_sha256"):
            problems.append(f"{path.name}: not the file named in {INDEX_NAME} (its hash differs)")
    if problems:
        return problems
    try:
        expected, rejects = build_index([present[name] for name in names])
    except LabelgenError as err:
        return [str(err)]
    for key, value in expected.items():
        if key == "shards":
            stated = [{k: v for k, v in entry.items() if k != "original"} for entry in index["shards"]]
            problems += [
                f"{INDEX_NAME}: its entry of {a['name']} differs from the shard"
                for a, b in zip(value, stated, strict=True)
                if a != b
            ]
        elif index.get(key) != value:
            problems.append(f"{INDEX_NAME}: {key} is {index.get(key)!r}, in its shards {value!r}")
    kinds = {(reader["pair"], reader["size"]) for reader in _attributes([present[name] for name in names])}
    if len(kinds) > 1:
        problems.append(f"shards of different pairs or sizes: {', '.join(' '.join(kind) for kind in sorted(kinds))}")
    try:
        if (folder / REJECTS_NAME).read_bytes() != rejects:
            problems.append(f"{REJECTS_NAME}: differs from the shards")
    except OSError as err:
        problems.append(f"{REJECTS_NAME}: {err.strerror or err}")
    return problems


def _attributes(paths: Sequence[Path]) -> Iterator[dict[str, Any]]:
    for path in paths:
        with ShardReader(path) as reader:
            yield reader.attributes


def content_is_intact(path: Path) -> bool:
    """Return whether a shard is readable and its content has the hash that was written with it."""
    try:
        with ShardReader(path) as reader:
            attributes = reader.attributes
        return bool(content_hash(attributes, _read_all(path)) == attributes[HASH_ATTRIBUTE])
    except (LabelgenError, *_UNREADABLE):
        return False


def validate_shard(path: str | Path) -> list[str]:
    """Return the problems of one shard: fields, types, offsets, values, images, content hash."""
    with ShardReader(path) as reader:
        try:
            attributes = reader.attributes
            reader.pair, reader.size_wh, reader.settings  # noqa: B018  parsed for their errors
        except (LabelgenError, *_UNREADABLE) as err:
            return [str(err)]
        try:
            arrays = _read_all(Path(path))
        except _UNREADABLE as err:
            return [f"cannot be read ({' '.join(str(err).split())})"]
        problems = _check_layout(arrays)
        if not problems:
            if content_hash(attributes, arrays) != attributes[HASH_ATTRIBUTE]:
                problems.append("its content is not what was written (hash differs)")
            problems += _check_values(arrays)
            problems += _check_images(arrays, reader.size_wh)
            try:
                reader.cameras, reader.rejects  # noqa: B018
            except (LabelgenError, *_UNREADABLE) as err:
                problems.append(str(err))
        return problems


def _read_all(path: Path) -> dict[str, NDArray[Any]]:
    with h5py.File(path, "r", locking=False) as file:
        return {name: file[name].asstr()[()] if spec.dtype == TEXT else file[name][()] for name, spec in FIELDS.items()}


def _check_layout(arrays: dict[str, NDArray[Any]]) -> list[str]:
    rows = {
        "N": len(arrays["samples/frame"]),
        "N+1": len(arrays["samples/frame"]) + 1,
        "L": len(arrays["labels/cc"]),
        "C": len(arrays["cameras/scale"]),
    }
    problems = []
    for name, spec in FIELDS.items():
        array = arrays[name]
        if spec.dtype != TEXT and array.dtype != np.dtype(spec.dtype):
            problems.append(f"{name}: expected type {spec.dtype}, got {array.dtype}")
        expected = (rows.get(spec.rows, len(array)), *spec.shape)
        if array.shape != expected:
            problems.append(f"{name}: expected shape {expected}, got {array.shape}")
    for name, total in (("images/offset", len(arrays["images/bytes"])), ("labels/offset", rows["L"])):
        offsets = arrays[name]
        if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != total or (np.diff(offsets) < 0).any():
            problems.append(f"{name}: expected to rise from 0 to {total}")
    return problems


def _check_values(arrays: dict[str, NDArray[Any]]) -> list[str]:
    box, cc, camera = arrays["labels/box"], arrays["labels/cc"], arrays["samples/camera"]
    checks = {
        "labels/box: expected finite x0 < x1, y0 < y1": np.isfinite(box).all(1) & (box[:, :2] < box[:, 2:]).all(1),
        "labels/cc: expected values in [0, 1]": (cc >= 0) & (cc <= 1),
        "labels/class: unknown class": np.isin(arrays["labels/class"], [int(c) for c in VehicleClass]),
        "samples/split: unknown split": np.isin(arrays["samples/split"], [int(s) for s in Split]),
        "samples/matrix: expected finite numbers": np.isfinite(arrays["samples/matrix"]).all((1, 2)),
        "samples/vpu: expected finite numbers": np.isfinite(arrays["samples/vpu"]).all(1),
        "samples/camera: no such camera": (camera >= 0) & (camera < len(arrays["cameras/scale"])),
    }
    problems = [f"{what} (first at row {int((~good).argmax())})" for what, good in checks.items() if not good.all()]
    if not problems:
        vpu = np.repeat(arrays["samples/vpu"], np.diff(arrays["labels/offset"]), axis=0)
        _, valid = decode_boxes(box, cc, vpu)
        valid |= (arrays["labels/flags"] & Flag.FLAT.value) > 0
        if not valid.all():
            problems.append(f"labels: {int((~valid).sum())} have no 3D box (first at row {int((~valid).argmax())})")
    return problems


def _check_images(arrays: dict[str, NDArray[Any]], size_wh: tuple[int, int]) -> list[str]:
    offsets = arrays["images/offset"]
    for i in range(len(offsets) - 1):
        data = arrays["images/bytes"][offsets[i] : offsets[i + 1]]
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        if image is None or image.shape[1::-1] != size_wh:
            return [f"images: number {i} is not an image of {size_wh[0]}x{size_wh[1]} px"]
    return []
