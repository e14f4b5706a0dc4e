"""Rejects: inputs without a label, each with its reason."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass

from labelgen.json_file import parse_json

__all__ = ["INPUT_PROBLEM", "Reject", "from_json_lines", "to_json_lines"]

INPUT_PROBLEM = "input problem"
"""Reason of a reject that is about the input as a whole."""


@dataclass(frozen=True)
class Reject:
    """One input without a label.

    Args:
        source: name of the file or of the item of the data set.
        frame: frame or instance number; -1 where there is none.
        item: number of the mask in its frame; -1 for the whole image.
        reason: a short phrase that is the same for all rejects of a kind; they are counted by it.
        detail: what was wrong with this input.
    """

    source: str
    frame: int
    item: int
    reason: str
    detail: str = ""


def writable(text: str) -> str:
    """Return text that HDF5 and UTF-8 can hold: names of files may have bytes that are no UTF-8, written as escapes."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")


def to_json_lines(rejects: Iterable[Reject]) -> bytes:
    """Return rejects as JSON lines, UTF-8."""
    return b"".join(_line(reject) for reject in rejects)


def _line(reject: Reject) -> bytes:
    values = {key: writable(value) if isinstance(value, str) else value for key, value in asdict(reject).items()}
    return json.dumps(values, ensure_ascii=False).encode() + b"\n"


def from_json_lines(data: bytes) -> list[Reject]:
    """Parse the bytes of `to_json_lines`.

    Raises:
        ValueError: a line is not a JSON object with the fields of `Reject`, of their types.
    """
    return [_parse(number, line) for number, line in enumerate(data.splitlines(), 1)]


def _parse(number: int, line: bytes) -> Reject:
    value = parse_json(line)
    types = {"source": str, "frame": int, "item": int, "reason": str, "detail": str}
    if not isinstance(value, dict) or {key: type(part) for key, part in value.items()} != types:
        raise ValueError(f"rejects: line {number} is not a reject with {', '.join(types)}")
    return Reject(**value)
