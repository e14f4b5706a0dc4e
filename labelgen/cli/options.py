"""What the commands share: option texts, the closing summary, --json."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.atomic_files import write_json
from labelgen.errors import OutputError
from labelgen.shards.index import DatasetSummary

__all__ = [
    "CalibrationOption",
    "JsonOption",
    "OverwriteOption",
    "PairOption",
    "QualityOption",
    "RoadMaskOption",
    "SceneSizeOption",
    "WorkersOption",
    "check_report_path",
    "note",
    "print_table",
    "show_summary",
    "write_json_report",
]

PairOption = Annotated[
    str, typer.Option("--pair", metavar="PAIR", help="Vanishing points made axis-parallel: VP2-VP3 or VP1-VP2.")
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration", metavar="FILE", help="Camera JSON; else the session's, NAME.calibration.json, or made."
    ),
]
RoadMaskOption = Annotated[
    Path | None,
    typer.Option("--road-mask", metavar="FILE", help="Road mask; else the session's, NAME.mask.png, or made."),
]
SceneSizeOption = Annotated[
    str | None,
    typer.Option("--size", metavar="WxH", help="Rectified size; 640x360 by default, 360x640 for VP1-VP2."),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace what the output already holds. Without it, nothing is replaced.")
]
JsonOption = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the closing summary as JSON as well.")
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Processes; 0 for one per core. Any number gives the same bytes.")
]
QualityOption = Annotated[
    int, typer.Option("--quality", metavar="Q", help="JPEG quality of the images, 1 to 100; 0 for lossless PNG.")
]


def note(text: str) -> None:
    """A line on standard error."""
    typer.echo(f"note: {text}", err=True)


def print_table(rows: list[tuple[str, Any]]) -> None:
    """Two aligned columns on standard output."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        typer.echo(f"  {name:<{width}}  {value}")


def check_report_path(path: Path | None, *others: Path | None) -> None:
    """Refuse a --json that could not be written after all the work, or that is another output's file."""
    if path is None:
        return
    if path.is_dir():
        raise OutputError(f"--json {path}: it is a folder; name a file")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise OutputError(f"--json {path}: its folder is missing or cannot be written; choose another file")
    if any(other is not None and other.resolve() == path.resolve() for other in others):
        raise OutputError(f"--json {path}: it is the output itself; choose another file")


def write_json_report(path: Path | None, data: Any) -> None:
    """Write --json, if asked for."""
    if path is not None:
        write_json(path, data)


def show_summary(title: str, summary: DatasetSummary, out: Path | None, json_file: Path | None) -> None:
    """Print the closing table and write --json."""
    typer.echo(title)
    rows: list[tuple[str, Any]] = [
        ("images", summary.images),
        ("labels", summary.labels),
        ("rejects", summary.rejects),
        *((f"  {reason}", count) for reason, count in summary.reasons.most_common()),
        ("shards", summary.shards),
        *summary.extra.items(),
    ]
    if out is not None:
        rows.append(("in", out))
    print_table(rows)
    for warning in summary.warnings:
        typer.echo(f"note: {warning}", err=True)
    write_json_report(json_file, {**summary.to_dict(), **({"out": str(out)} if out is not None else {})})
