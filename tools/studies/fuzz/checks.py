"""What the output of a successful run must be; a command that ends well with anything else went wrong."""

from __future__ import annotations

import csv
import json
import math
import re
from pathlib import Path
from typing import Any

from labelgen.errors import LabelgenError
from labelgen.shards import validate_shards

__all__ = ["wrong_success"]

# No vehicle on a road is faster, km/h.
_MAX_SPEED_KMH = 400.0


def wrong_success(command: str, work: Path, printed: str) -> str:
    """Return what is wrong with the outputs of a run that ended with exit code 0; empty where nothing is.

    Args:
        command: name of the command.
        work: folder of the case; outputs lie below it and are named `out`.
        printed: what the command printed.
    """
    out = work / "out"
    if re.search(r"^  \S.*  -?(nan|inf)\b", printed, re.IGNORECASE | re.MULTILINE):  # a value of a table
        return "prints a number that is none"
    for path in sorted(work.glob("out*")):
        for file in [path, *sorted(path.rglob("*"))] if path.is_dir() else [path]:
            if problem := _wrong_file(file):
                return f"{file.relative_to(work)}: {problem}"
    if command in ("bcs-masks", "boxcars", "merge") and out.is_dir():
        return _invalid_shards(out)
    return ""


def _wrong_file(path: Path) -> str:
    if not path.is_file():
        return ""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
        elif path.suffix == ".jsonl":
            for line in path.read_text(encoding="utf-8").splitlines():
                json.loads(line, parse_constant=_refuse)
        elif path.suffix == ".csv":
            return _wrong_speeds(path)
        elif path.suffix in (".png", ".jpg", ".onnx") and path.stat().st_size == 0:
            return "is empty"
    except ValueError as err:
        return str(err)[:200]
    return ""


def _refuse(name: str) -> Any:
    raise ValueError(f"holds {name}, which is no JSON")


def _wrong_speeds(path: Path) -> str:
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            speed = float(row.get("speed_kmh") or 0)
            if not (math.isfinite(speed) and 0 <= speed <= _MAX_SPEED_KMH):
                return f"a speed of {speed} km/h"
    return ""


def _invalid_shards(folder: Path) -> str:
    try:
        problems = [line for lines in validate_shards([folder]).values() for line in lines]
    except LabelgenError as err:
        problems = [str(err)]
    return f"invalid shards: {problems[0]}" if problems else ""
