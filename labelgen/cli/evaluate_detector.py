"""`labelgen test-detector`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labelgen.before_torch import check_device, check_torch_file
from labelgen.cli.options import JsonOption, check_report_path, print_table, write_json_report
from labelgen.cli.printing import say
from labelgen.progress import progress_bar

if TYPE_CHECKING:
    from detector.inference import Detector
    from labelgen.labels import Labels, Sample
    from labelgen.shards import ShardDataset

__all__ = ["evaluate_detector"]


def evaluate_detector(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="Written by labelgen train.")],
    shards: Annotated[list[Path], typer.Argument(metavar="SHARDS...", help="Shards or folders of them.")],
    score: Annotated[
        float, typer.Option("--score", min=0.0, max=1.0, help="Least score, for all but average precision.")
    ] = 0.5,
    batch: Annotated[int, typer.Option("--batch", min=1, help="Pictures at a time.")] = 8,
    device: Annotated[str | None, typer.Option("--device", help="Torch device; the GPU when there is one.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Judge a detector on labelled shards: AP, AP50, AP75, c_c, ground points, invalid boxes.

    Figures ending in _whole leave truncated labels out: they need not be found and cost nothing when they are.
    """
    check_torch_file(checkpoint, f"checkpoint {checkpoint}")
    check_device(device)
    from detector.data.dataset import open_shards
    from detector.inference import load_detector
    from detector.metrics import evaluate_detections

    check_report_path(json_file)
    detector = load_detector(checkpoint, device=device)
    metadata = detector.metadata
    samples = open_shards(shards, metadata.pair, metadata.size_wh)
    result = evaluate_detections(_run(detector, samples, batch), score=score, min_height_px=metadata.min_height_px)
    size = "{}x{}".format(*metadata.size_wh)
    say(f"{checkpoint.name} ({metadata.preset}, {metadata.pair}, {size}) on {len(samples)} pictures")
    print_table(_rows(result))
    write_json_report(json_file, {"checkpoint": str(checkpoint), "preset": metadata.preset, **result})


def _run(detector: Detector, samples: ShardDataset[Sample], batch: int) -> Iterator[tuple[Sample, Labels]]:
    with progress_bar(len(samples), "img") as advance:
        for start in range(0, len(samples), batch):
            part = [samples[i] for i in range(start, min(start + batch, len(samples)))]
            yield from zip(part, detector.detect([detector.input_of_sample(sample) for sample in part]), strict=True)
            advance(len(part))


def _rows(result: dict[str, Any]) -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in result.items():
        if isinstance(value, dict):
            figures = [f"{key} {value[key]:.4g}" for key in ("median", "mean", "p95") if value["n"]]
            rows.append((name, f"{', '.join(figures) or '-'} (n {value['n']})"))
        else:
            rows.append((name, f"{value:.4f}" if isinstance(value, float) else "-" if value is None else value))
    return rows
