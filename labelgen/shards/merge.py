"""Merging finished data sets into one; samples, labels and rejects stay as they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.errors import DataError
from labelgen.shards.dataset import find_shards
from labelgen.shards.index import INDEX_NAME, DatasetSummary, read_index, summarise, write_index
from labelgen.shards.reader import ShardReader
from labelgen.shards.schema import HASH_ATTRIBUTE, VERSION
from labelgen.shards.validate import validate_shards
from labelgen.shards.writer import shard_bytes

__all__ = ["merge_job", "merge_shards"]


def merge_job(shards: Sequence[Path]) -> dict[str, Any]:
    """Return the identity of a merging of shards, as its index states it."""
    return {"command": "merge", "inputs": sorted({str(path.parent) for path in shards})}


def merge_shards(paths: Sequence[str | Path], out: Path) -> DatasetSummary:
    """Copy shards of several data sets into one folder, renumbered, with a common index.

    Of shards with the same content the first is copied. Shards of older versions of the format become such of the
    newest one.

    Args:
        paths: shards or folders of shards, all of one pair and size.
        out: a new or empty folder.

    Returns:
        Counts of the merged data set.

    Raises:
        DataError: shards of different pairs or sizes, or such as `validate_shards` refuses; nothing is written then.
        OutputError: the folder cannot be written.
    """
    shards = find_shards(paths)
    _refuse_invalid(paths, shards)
    by_hash: dict[str, Path] = {}
    kinds: dict[tuple[str, str], Path] = {}
    for path in shards:
        with ShardReader(path) as reader:
            kinds.setdefault((reader.attributes["pair"], reader.attributes["size"]), path)
        by_hash.setdefault(_newest_version(path)[1], path)
    if len(kinds) > 1:
        listed = "; ".join(f"{path}: {pair} {size}" for (pair, size), path in kinds.items())
        raise DataError(f"cannot merge shards of different pairs or sizes ({listed}); merge each kind on its own")
    originals: dict[str, Any] = {}
    by_folder = {folder: _originals(folder) for folder in {path.parent for path in shards}}
    make_folder(out)
    written = []
    for number, path in enumerate(by_hash.values()):
        target = out / f"shard-{number:05d}.h5"
        write_atomic(target, _newest_version(path)[0]())
        originals[target.name] = by_folder[path.parent].get(path.name, {})
        written.append(target)
    write_index(out, written, merge_job(shards), originals)
    summary = summarise([ShardReader(path) for path in written])
    if len(by_hash) < len(shards):
        summary.warnings.append(f"{len(shards) - len(by_hash)} shards were there twice and are taken once")
    return summary


def _refuse_invalid(paths: Sequence[str | Path], shards: Sequence[Path]) -> None:
    """Refuse what validation refuses, but for folders without an index."""
    folders = {Path(path) for path in paths if (Path(path) / INDEX_NAME).is_file()}
    problems = {where: found for where, found in validate_shards([*sorted(folders), *shards]).items() if found}
    if problems:
        where, found = next(iter(problems.items()))
        first, others = found[0].removeprefix(f"{where}: "), sum(map(len, problems.values())) - 1
        more = f", and {others} more problems" if others else ""
        raise DataError(f"{where}: {first}{more}; nothing was merged, labelgen validate lists all problems")


def _newest_version(path: Path) -> tuple[Callable[[], bytes], str]:
    """Return what reads the bytes of a valid shard in the newest version of the format, and its content hash there."""
    with ShardReader(path) as reader:
        if reader.attributes["version"] == VERSION:
            return path.read_bytes, str(reader.attributes[HASH_ATTRIBUTE])
        attributes = {key: value for key, value in reader.attributes.items() if key != HASH_ATTRIBUTE}
        content, digest = shard_bytes(attributes, reader.read_all())
        return lambda: content, digest


def _originals(folder: Path) -> dict[str, Any]:
    if not (folder / INDEX_NAME).is_file():
        return {}
    return {str(entry["name"]): entry.get("original", {}) for entry in read_index(folder)["shards"]}
