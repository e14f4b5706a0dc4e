"""`labelgen export-model`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.commands.common import JsonOption, OverwriteOption, print_table, write_json_report

__all__ = ["export_model"]


def export_model(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="Written by labelgen train.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="File to write.")],
    format_: Annotated[str, typer.Option("--format", help="onnx.")] = "onnx",
    score: Annotated[float, typer.Option("--score", min=0.0, max=1.0, help="Least score of a detection.")] = 0.3,
    check: Annotated[bool, typer.Option("--check/--no-check", help="Compare with PyTorch on a random picture.")] = True,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Write a detector for other runtimes: one rectified RGB picture in, boxes, scores and c_c out, NMS included."""
    from detector.export import check_onnx, export_onnx
    from labelgen.errors import LabelgenError, OutputError

    if format_ != "onnx":
        raise LabelgenError(f"--format {format_}: unknown; use onnx")
    if out.exists() and not overwrite:
        raise OutputError(f"{out}: it exists already; use --overwrite or another --out")
    card = export_onnx(checkpoint, out, score=score)
    difference = check_onnx(checkpoint, out, score=score) if check else None
    rows = [("in", out), ("size", f"{card.size_wh[0]}x{card.size_wh[1]}"), ("bytes", out.stat().st_size)]
    if difference is not None:
        rows.append(("greatest difference from PyTorch", f"{difference:.2e}"))
    typer.echo(f"Exported {checkpoint.name} ({card.preset}, {card.pair})")
    print_table(rows)
    write_json_report(
        json_file, {"out": str(out), "pair": str(card.pair), "size": list(card.size_wh), "difference": difference}
    )
