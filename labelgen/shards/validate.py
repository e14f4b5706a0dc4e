"""Validation of shards: the rules of the format, all values and images, and the content hash."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.choices import parse_size
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry.box_codec import decode_boxes
from labelgen.json_file import parse_json
from labelgen.labels import Flag
from labelgen.media.image_file import decode_image
from labelgen.shards.dataset import find_shards
from labelgen.shards.index import INDEX_NAME, REJECTS_NAME, build_index, file_hash, read_index
from labelgen.shards.layout import (
    DAMAGE,
    check_attributes,
    check_fields,
    check_values,
    open_shard_file,
    read_attributes,
    read_fields,
)
from labelgen.shards.reader import ShardReader
from labelgen.shards.schema import HASH_ATTRIBUTE, IMAGES, content_hash

__all__ = ["content_is_intact", "validate_folder", "validate_shard", "validate_shards"]


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
            arrays = reader.read_all()
        return bool(content_hash(attributes, arrays) == attributes[HASH_ATTRIBUTE])
    except DAMAGE:
        return False


def validate_shard(path: str | Path) -> list[str]:
    """Return the problems of one shard: attributes, fields, types, offsets, values, images, content hash."""
    path = Path(path)
    try:
        file_bytes = path.stat().st_size if path.exists() else 0
        with open_shard_file(path) as file:
            attributes = read_attributes(file)
            problems = check_attributes(attributes) or check_fields(file, attributes["version"], file_bytes)
            if problems:
                return problems
            arrays = read_fields(file, attributes["version"], file_bytes)
    except DataError as err:
        return [str(err)]
    except DAMAGE as err:
        return [f"cannot be read ({' '.join(str(err).split())})"]
    if content_hash(attributes, arrays) != attributes[HASH_ATTRIBUTE]:
        problems.append("its content is not what was written (hash differs)")
    wrong = check_values(arrays, len(arrays[IMAGES]), parse_json(attributes["settings"]))
    problems += wrong
    if not wrong:
        problems += _check_boxes(arrays)
        problems += _check_images(arrays, parse_size(attributes["size"]))
        with ShardReader(path) as reader:
            for read in (lambda: reader.cameras, lambda: reader.rejects):
                try:
                    read()
                except DataError as err:
                    problems.append(str(err))
    return problems


def _check_boxes(arrays: dict[str, NDArray[Any]]) -> list[str]:
    """Check that every label of a rectified image has a 3D box."""
    vpu = np.repeat(arrays["samples/vpu"], np.diff(arrays["labels/offset"]), axis=0)
    with np.errstate(all="ignore"):
        _, valid = decode_boxes(arrays["labels/box"], arrays["labels/cc"], vpu)
    valid |= (arrays["labels/flags"] & Flag.FLAT.value) > 0
    if valid.all():
        return []
    return [f"labels: {int((~valid).sum())} have no 3D box (first at row {int((~valid).argmax())})"]


def _check_images(arrays: dict[str, NDArray[Any]], size_wh: tuple[int, int]) -> list[str]:
    offsets = arrays["images/offset"]
    for i in range(len(offsets) - 1):
        try:
            decode_image(arrays[IMAGES][offsets[i] : offsets[i + 1]], "image", expected_wh=size_wh)
        except DataError:
            return [f"images: number {i} is not an image of {size_wh[0]}x{size_wh[1]} px"]
    return []
