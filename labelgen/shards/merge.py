"""Merging finished data sets into one, without touching what the shards say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.errors import DataError
from labelgen.shards.dataset import find_shards
from labelgen.shards.index import INDEX_NAME, DatasetSummary, read_index, summarise, write_index
from labelgen.shards.reader import ShardReader
from labelgen.shards.schema import HASH_ATTRIBUTE

__all__ = ["merge_shards"]


def merge_shards(paths: Sequence[str | Path], out: Path) -> DatasetSummary:
    """Copy shards of several data sets into one folder, renumbered, with a common index.

    Shards that hold the same content are taken once.

    Args:
        paths: shards or folders, all of one pair and size.
        out: a new or empty folder.

    Raises:
        DataError: shards of different pairs or sizes, or damaged ones; nothing is written then.
        OutputError: the folder cannot be written.
    """
    shards = find_shards(paths)
    kept: dict[str, Path] = {}
    kinds: dict[tuple[str, str], Path] = {}
    for path in shards:
        with ShardReader(path) as reader:
            kinds.setdefault((reader.attributes["pair"], reader.attributes["size"]), path)
            kept.setdefault(reader.attributes[HASH_ATTRIBUTE], path)
    if len(kinds) > 1:
        seen = "; ".join(f"{path}: {pair} {size}" for (pair, size), path in kinds.items())
        raise DataError(f"cannot merge shards of different pairs or sizes ({seen}); merge each kind on its own")
    originals: dict[str, Any] = {}
    known = {folder: _originals(folder) for folder in {path.parent for path in shards}}
    make_folder(out)
    written = []
    for number, path in enumerate(kept.values()):
        target = out / f"shard-{number:05d}.h5"
        write_atomic(target, path.read_bytes())
        originals[target.name] = known[path.parent].get(path.name, {})
        written.append(target)
    job = {"command": "merge", "inputs": sorted(str(folder) for folder in known)}
    write_index(out, written, job, originals)
    summary = summarise([ShardReader(path) for path in written])
    if len(kept) < len(shards):
        summary.warnings.append(f"{len(shards) - len(kept)} shards were there twice and are taken once")
    return summary


def _originals(folder: Path) -> dict[str, Any]:
    if not (folder / INDEX_NAME).is_file():
        return {}
    return {str(entry["name"]): entry.get("original", {}) for entry in read_index(folder)["shards"]}
