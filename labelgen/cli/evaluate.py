"""`labelgen evaluate`: score speeds by the public protocol."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from labelgen.errors import DataError

__all__ = ["evaluate"]


def evaluate(
    dataset: Annotated[Path, typer.Option(metavar="DIR", help="Folder with sessionN_left/gt_data.pkl and so on.")],
    results: Annotated[Path, typer.Option(metavar="DIR", help="Folder with sessionN_left/system_NAME.json.")],
    system: Annotated[list[str], typer.Option(metavar="NAME...", help="System to score; several to compare.")],
    more_systems: Annotated[list[str] | None, typer.Argument(metavar="[NAME...]", hidden=True)] = None,
    recordings: Annotated[
        str, typer.Option(metavar="split-C|all|NAME,...", help="What to score; split-C is sessions 4 to 6.")
    ] = "split-C",
    calibration: Annotated[
        str, typer.Option(metavar="NAME", help="Measure with this system's calibration; own: each with its own.")
    ] = "own",
    common_recall: Annotated[
        bool, typer.Option("--common-recall", help="Speed errors of only the vehicles that all systems found.")
    ] = False,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help="Write cumulative error plots here.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all figures here.")] = None,
    table: Annotated[
        str, typer.Option("--format", metavar="text|markdown|csv", help="How to print the tables.")
    ] = "text",
) -> None:
    """Score tracks against ground truth, by the data set's public protocol.

    BrnoCompSpeed: speed errors of the matched, valid vehicles (median of a track's speeds over 5 points), recall,
    false positives, calibration and distance errors, for each recording and pooled over all vehicles. Precision,
    which the public script does not have, is matched / (matched + false positives).

    A folder of the Luvizon data set is known by its layout and scored by its own protocol; there --recordings takes
    test (the default), training, all, or names such as subset01/video01.
    """
    from detector.evaluation import TableFormat, is_luvizon
    from labelgen.atomic_files import write_json

    style = TableFormat.parse(table)
    systems = _names([*system, *(more_systems or [])])
    if is_luvizon(dataset):
        from detector.evaluation.report import evaluate_luvizon

        if calibration != "own" or common_recall or plots is not None:
            raise DataError(f"{dataset} is of the Luvizon layout: no --calibration, --common-recall or --plots there")
        choice = "test" if recordings.lower() == "split-c" else recordings
        summary = evaluate_luvizon(dataset, results, systems, choice, style)
    else:
        from detector.evaluation.report import evaluate_brnocompspeed

        summary = evaluate_brnocompspeed(
            dataset, results, systems, recordings, calibration, common=common_recall, plots=plots, style=style
        )
    if json_file is not None:
        write_json(json_file, summary)


def _names(values: Sequence[str]) -> list[str]:
    """Systems by name, however many an option holds, each once."""
    names = [name.strip() for value in values for name in value.split(",")]
    return list(dict.fromkeys(name.removesuffix(".json").removeprefix("system_") for name in names if name))
