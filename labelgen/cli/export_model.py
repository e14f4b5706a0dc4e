"""`labelgen export-model`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labelgen.before_torch import check_torch_file
from labelgen.cli.options import JsonOption, OverwriteOption, check_report_path, print_table, write_json_report
from labelgen.cli.printing import say

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from detector.checkpoint import ModelMetadata

__all__ = ["export_model"]

_CHECKED = 20


def export_model(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="Written by labelgen train.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="File to write.")],
    format_: Annotated[str, typer.Option("--format", help="onnx.")] = "onnx",
    score: Annotated[float, typer.Option("--score", min=0.0, max=1.0, help="Least score of a detection.")] = 0.3,
    check: Annotated[
        Path | None, typer.Option("--check", metavar="SHARDS", help="Compare with PyTorch on pictures of these shards.")
    ] = None,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Write a detector for other runtimes: one rectified RGB picture in, boxes, scores and c_c out, NMS included."""
    check_torch_file(checkpoint, f"checkpoint {checkpoint}")
    from detector.export_onnx import check_onnx, export_onnx
    from labelgen.errors import LabelgenError
    from labelgen.staged_output import staged_file

    if format_ != "onnx":
        raise LabelgenError(f"--format {format_}: unknown; use onnx")
    check_report_path(json_file, out)
    with staged_file(out, overwrite=overwrite) as staged:
        metadata = export_onnx(checkpoint, staged, score=score)
    rows: list[tuple[str, Any]] = [
        ("in", out), ("size", "{}x{}".format(*metadata.size_wh)), ("bytes", out.stat().st_size)
    ]  # fmt: skip
    parity = None
    if check is not None:
        parity = check_onnx(checkpoint, out, _pictures(check, metadata), score=score)
        rows += [("boxes compared", parity.boxes), ("greatest difference, px", f"{parity.px:.2e}")]
        rows += [("of scores", f"{parity.score:.2e}"), ("of c_c, sizes", f"{parity.cc:.2e}, {parity.sizes:.2e}")]
    say(f"Exported {checkpoint.name} ({metadata.preset}, {metadata.pair})")
    print_table(rows)
    write_json_report(
        json_file,
        {
            "out": str(out), "pair": str(metadata.pair), "size": list(metadata.size_wh),
            "parity": None if parity is None else asdict(parity),
        },
    )  # fmt: skip


def _pictures(shards: Path, metadata: ModelMetadata) -> list[NDArray[np.float32]]:
    import numpy as np

    from detector.data.dataset import open_shards

    samples = open_shards([shards], metadata.pair, metadata.size_wh)
    numbers = np.unique(np.linspace(0, len(samples) - 1, _CHECKED).astype(int)).tolist()
    return [samples[i].image[:, :, ::-1].transpose(2, 0, 1).astype(np.float32) / np.float32(255) for i in numbers]
