"""Rejects: inputs that gave no label, each with its reason, so that nothing disappears silently."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass

__all__ = ["Reject", "from_json_lines", "to_json_lines"]


@dataclass(frozen=True)
class Reject:
    """One input without a label.

    Args:
        source: which file or item of the data set.
        frame: frame or instance number; -1 where there is none.
        item: number of the mask in its frame; -1 where the whole image is meant.
        reason: a short constant phrase, to be counted by.
        detail: what exactly was wrong here.
    """

    source: str
    frame: int
    item: int
    reason: str
    detail: str = ""


def to_json_lines(rejects: Iterable[Reject]) -> bytes:
    """One JSON object a line, UTF-8."""
    return b"".join(json.dumps(asdict(reject), ensure_ascii=False).encode() + b"\n" for reject in rejects)


def from_json_lines(data: bytes) -> list[Reject]:
    """The reverse of `to_json_lines`."""
    return [Reject(**json.loads(line)) for line in data.splitlines()]
