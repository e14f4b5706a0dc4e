"""The index of a data set: `dataset.json` and `rejects.jsonl`, made from its shards."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from labelgen.atomic_files import write_atomic, write_json
from labelgen.errors import DataError
from labelgen.json_file import parse_json
from labelgen.labels import IgnoreReason
from labelgen.shards.reader import ShardReader
from labelgen.shards.rejects import INPUT_PROBLEM, to_json_lines
from labelgen.shards.schema import FORMAT, HASH_ATTRIBUTE, VERSION
from labelgen.version import __version__

__all__ = [
    "INDEX_NAME",
    "REJECTS_NAME",
    "DatasetSummary",
    "build_index",
    "file_hash",
    "read_index",
    "summarise",
    "write_index",
]

INDEX_NAME = "dataset.json"
REJECTS_NAME = "rejects.jsonl"
# Lines of one shard in a summary; all are in the file of the rejects.
_MAX_PROBLEMS = 100
_INDEX_FORMAT = f"{FORMAT}-index"


@dataclass
class DatasetSummary:
    """Counts of a data set or a job.

    Args:
        images: number of rectified images.
        labels: number of labels.
        rejects: number of inputs without a label.
        shards: number of files.
        reasons: number of rejects by reason.
        ignored: number of ignored boxes by reason.
        warnings: what a user must know of the data set.
        problems: what was skipped or left out of the input, one line each.
        notes: what else there is to say.
        extra: further figures, by name.
    """

    images: int = 0
    labels: int = 0
    rejects: int = 0
    shards: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the counts as plain values for JSON."""
        return {
            "images": self.images,
            "labels": self.labels,
            "rejects": self.rejects,
            "shards": self.shards,
            "rejects_by_reason": dict(sorted(self.reasons.items())),
            "ignored": self.ignored.total(),
            "ignored_by_reason": dict(sorted(self.ignored.items())),
            "warnings": [*self.warnings, *self.notes],
            "problems": self.problems,
            **self.extra,
        }


def summarise(readers: Sequence[ShardReader]) -> DatasetSummary:
    """Count what shards hold; each is closed afterwards.

    Raises:
        DataError: a shard is missing or damaged.
    """
    summary = DatasetSummary(shards=len(readers))
    for reader in readers:
        summary.images += len(reader)
        summary.labels += reader.label_count
        summary.rejects += len(reader.rejects)
        summary.reasons.update(reject.reason for reject in reader.rejects)
        summary.ignored.update(IgnoreReason(reason).text for reason in reader.table("ignored/reason").tolist())
        problems = dict.fromkeys(reject.detail for reject in reader.rejects if reject.reason == INPUT_PROBLEM)
        summary.problems += [line for line in problems if line not in summary.problems][:_MAX_PROBLEMS]
        reader.close()
    return summary


def write_index(
    folder: Path, shards: Sequence[Path], job: Mapping[str, Any], originals: Mapping[str, Any] | None = None
) -> None:
    """Write `rejects.jsonl` and then `dataset.json`: a data set that has an index is complete.

    Args:
        folder: of the data set.
        shards: its files, in order.
        job: the job that made them, as plain values.
        originals: where the original images lie on this machine, by the shard's name or its source; the audit uses it.

    Raises:
        DataError: a shard is missing or damaged.
        OutputError: the files cannot be written.
    """
    index, rejects = build_index(shards)
    for entry in index["shards"]:
        places = originals or {}
        entry["original"] = places.get(entry["name"], places.get(entry["source"], {}))
    write_atomic(folder / REJECTS_NAME, rejects)
    write_json(folder / INDEX_NAME, {**index, "producer": f"labelgen {__version__}", "job": dict(job)})


def build_index(shards: Sequence[Path]) -> tuple[dict[str, Any], bytes]:
    """Return the index and the bytes of the rejects file that belong to shards, from what the shards hold."""
    entries: list[dict[str, Any]] = []
    rejects: list[bytes] = []
    reasons: Counter[str] = Counter()
    pair, size, version = "", "", 1
    for path in shards:
        with ShardReader(path) as reader:
            pair, size = reader.attributes["pair"], reader.attributes["size"]
            version = max(version, reader.attributes["version"])
            reasons.update(reject.reason for reject in reader.rejects)
            rejects.append(to_json_lines(reader.rejects))
            entries.append(
                {
                    "name": path.name,
                    "source": reader.attributes["source"],
                    "images": len(reader),
                    "labels": reader.label_count,
                    "rejects": len(reader.rejects),
                    HASH_ATTRIBUTE: reader.attributes[HASH_ATTRIBUTE],
                    "file_sha256": file_hash(path),
                }
            )
    whole = hashlib.sha256("\n".join(str(entry[HASH_ATTRIBUTE]) for entry in entries).encode()).hexdigest()
    index = {
        "format": _INDEX_FORMAT,
        "version": version if shards else VERSION,
        "pair": pair,
        "size": size,
        **{key: sum(entry[key] for entry in entries) for key in ("images", "labels", "rejects")},
        "rejects_by_reason": dict(sorted(reasons.items())),
        HASH_ATTRIBUTE: whole,
        "shards": entries,
    }
    return index, b"".join(rejects)


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_index(folder: Path) -> dict[str, Any]:
    """Return the index of a data set, the parsed `dataset.json` of its folder.

    Raises:
        DataError: it is missing or damaged.
    """
    path = folder / INDEX_NAME
    try:
        index = parse_json(path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{folder}: no {INDEX_NAME}; the job was not finished, run the same command again") from None
    except (OSError, ValueError) as err:
        raise DataError(f"{path}: not readable ({err})") from None
    problem = _index_problem(index)
    if problem:
        raise DataError(f"{path}: not an index of shards ({problem}); make the data set again")
    return dict(index)


_COUNTS = ("images", "labels", "rejects")
_ORIGINALS = ("path", "images", "calibration", "road_mask", "masks", "weights")


def _index_problem(index: Any) -> str:
    """Return what is wrong with the types and values of a parsed index; "" where nothing is."""
    if not isinstance(index, dict):
        return "no JSON object"
    entries = index.get("shards")
    if not isinstance(entries, list):
        return "no list of shards"
    texts, objects = ("format", "pair", "size", "producer", HASH_ATTRIBUTE), ("job", "rejects_by_reason")
    for key, kind in [*((key, str) for key in texts), *((key, dict) for key in objects)]:
        if not isinstance(index.get(key, kind()), kind):
            return f"its {key} is of another type"
    if index.get("format", _INDEX_FORMAT) != _INDEX_FORMAT:
        return f"its format is {index['format']}"
    problem = _count_problem(index)
    if problem:
        return problem
    names = set()
    for number, entry in enumerate(entries):
        problem = _entry_problem(entry)
        if problem:
            return f"shard number {number}: {problem}"
        names.add(entry["name"])
    return "" if len(names) == len(entries) else "a shard is named twice"


def _entry_problem(entry: Any) -> str:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        return "no object with a name"
    name = entry["name"]
    if Path(name).name != name or not name.endswith(".h5") or "\0" in name or "\\" in name:
        return "its name is not that of a file beside the index"
    for key in ("source", HASH_ATTRIBUTE, "file_sha256"):
        if not isinstance(entry.get(key, ""), str):
            return f"its {key} is no text"
    original = entry.get("original", {})
    if not isinstance(original, dict) or not all(
        original.get(key) is None or (isinstance(original[key], str) and "\0" not in original[key])
        for key in _ORIGINALS
    ):
        return "its original is not an object of paths"
    return _count_problem(entry)


def _count_problem(values: Mapping[str, Any]) -> str:
    for key in _COUNTS:
        value = values.get(key, 0)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            return f"its number of {key} is no count"
    return ""
