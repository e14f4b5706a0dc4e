"""The index of a data set: dataset.json and rejects.jsonl, made from its shards."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from labelgen import __version__
from labelgen.errors import DataError
from labelgen.files import write_atomic, write_json
from labelgen.shards.reader import ShardReader
from labelgen.shards.rejects import to_json_lines
from labelgen.shards.schema import FORMAT, HASH_ATTRIBUTE, VERSION

__all__ = ["INDEX_NAME", "REJECTS_NAME", "DatasetSummary", "read_index", "summarise", "write_index"]

INDEX_NAME = "dataset.json"
REJECTS_NAME = "rejects.jsonl"


@dataclass
class DatasetSummary:
    """Counts of a data set or a job.

    Args:
        images: rectified images.
        labels: vehicles labelled.
        rejects: inputs that gave no label.
        shards: files.
        reasons: rejects by reason.
        warnings: what a person should know.
        extra: further figures of the job.
    """

    images: int = 0
    labels: int = 0
    rejects: int = 0
    shards: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """For --json."""
        return {
            "images": self.images,
            "labels": self.labels,
            "rejects": self.rejects,
            "shards": self.shards,
            "rejects_by_reason": dict(sorted(self.reasons.items())),
            "warnings": self.warnings,
            **self.extra,
        }


def summarise(readers: Sequence[ShardReader]) -> DatasetSummary:
    """Counts over shards."""
    summary = DatasetSummary(shards=len(readers))
    for reader in readers:
        summary.images += len(reader)
        summary.labels += reader.label_count
        summary.rejects += len(reader.rejects)
        summary.reasons.update(reject.reason for reject in reader.rejects)
    return summary


def write_index(
    folder: Path, shards: Sequence[Path], job: Mapping[str, Any], sources: Mapping[str, Any] | None = None
) -> DatasetSummary:
    """Write rejects.jsonl and, last of all, dataset.json: a data set with an index is complete.

    Args:
        folder: of the data set.
        shards: its files, in order.
        job: what made them.
        sources: where the originals lie on this machine, for looking at labels; by name.
    """
    readers = [ShardReader(path) for path in shards]
    summary = summarise(readers)
    write_atomic(folder / REJECTS_NAME, b"".join(to_json_lines(reader.rejects) for reader in readers))
    entries = [
        {
            "name": reader.path.name,
            "source": reader.attributes["source"],
            "images": len(reader),
            "labels": reader.label_count,
            "rejects": len(reader.rejects),
            HASH_ATTRIBUTE: reader.attributes[HASH_ATTRIBUTE],
        }
        for reader in readers
    ]
    for reader in readers:
        reader.close()
    whole = hashlib.sha256("\n".join(str(entry[HASH_ATTRIBUTE]) for entry in entries).encode()).hexdigest()
    write_json(
        folder / INDEX_NAME,
        {
            "format": f"{FORMAT}-index",
            "version": VERSION,
            "producer": f"labelgen {__version__}",
            "pair": str(readers[0].pair) if readers else "",
            "size": list(readers[0].size_wh) if readers else [],
            "images": summary.images,
            "labels": summary.labels,
            "rejects": summary.rejects,
            "rejects_by_reason": dict(sorted(summary.reasons.items())),
            HASH_ATTRIBUTE: whole,
            "job": dict(job),
            "sources": dict(sources or {}),
            "shards": entries,
        },
    )
    return summary


def read_index(folder: Path) -> dict[str, Any]:
    """dataset.json of a folder.

    Raises:
        DataError: missing or damaged.
    """
    path = folder / INDEX_NAME
    try:
        index = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{folder}: no {INDEX_NAME}; the job was not finished, run the same command again") from None
    except (OSError, ValueError) as err:
        raise DataError(f"{path}: not readable ({err})") from None
    if not isinstance(index, dict) or not isinstance(index.get("shards"), list):
        raise DataError(f"{path}: not an index of shards")
    return index
