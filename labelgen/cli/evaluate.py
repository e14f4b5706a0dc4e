"""`labelgen evaluate`: score speeds by the public protocol."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from detector.evaluation.tables import TableFormat
from labelgen.cli.options import check_report_path
from labelgen.cli.printing import say
from labelgen.errors import DataError

if TYPE_CHECKING:
    from detector.evaluation.report import LuvizonReport, SpeedReport

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
        TableFormat,
        typer.Option("--format", case_sensitive=False, metavar="text|markdown|csv", help="How to print the tables."),
    ] = TableFormat.TEXT,
) -> None:
    """Score tracks against ground truth, by the data set's public protocol.

    BrnoCompSpeed: speed errors of the matched, valid vehicles (median of a track's speeds over 5 points), recall,
    false positives, calibration and distance errors, for each recording and pooled over all vehicles. Precision,
    which the public script does not have, is matched / (matched + false positives).

    A folder of the Luvizon data set is known by its layout and scored by its own protocol; there --recordings takes
    test (the default), training, all, or names such as subset01/video01.
    """
    from detector.evaluation.report import PLOT_NAMES
    from labelgen.atomic_files import write_json
    from labelgen.datasets.luvizon import is_luvizon
    from labelgen.staged_output import StagedOutput

    check_report_path(json_file)
    systems = _names([*system, *(more_systems or [])])
    report: LuvizonReport | SpeedReport
    if is_luvizon(dataset):
        if calibration != "own" or common_recall or plots is not None:
            raise DataError(f"{dataset} is of the Luvizon layout: no --calibration, --common-recall or --plots there")
        report = _luvizon(dataset, results, systems, "test" if recordings.lower() == "split-c" else recordings)
        say(report.table(table))
    else:
        with nullcontext() if plots is None else StagedOutput(plots, "plots", PLOT_NAMES, overwrite=True) as output:
            report = _brnocompspeed(dataset, results, systems, recordings, calibration, common_recall)
            say(report.tables(table))
            if table is TableFormat.TEXT:
                say(f"\n{report.dropped_tracks()}")
            if output is not None:
                report.write_plots(output.path)
                output.publish()
                say(f"plots: {plots}", err=True)
    if json_file is not None:
        write_json(json_file, report.to_dict())


def _brnocompspeed(
    dataset: Path, results: Path, systems: Sequence[str], recordings: str, calibration: str, common_recall: bool
) -> SpeedReport:
    from tqdm import tqdm

    from detector.evaluation.report import SpeedReport
    from detector.evaluation.results_folder import score_results, select_recordings, split_c_test

    names = select_recordings(dataset, recordings)
    missing = [name for name in split_c_test() if name not in names]
    if recordings.lower() == "split-c" and missing:
        say(f"note: of split C's test recordings these are not in {dataset}: {', '.join(missing)}", err=True)
    scored = score_results(dataset, results, names, systems, calibration)
    progress = tqdm(scored, total=len(names) * len(systems), desc="scoring", unit="file", leave=False)
    return SpeedReport.create(progress, systems, names, common_recall=common_recall)


def _luvizon(dataset: Path, results: Path, systems: Sequence[str], recordings: str) -> LuvizonReport:
    from tqdm import tqdm

    from detector.evaluation.luvizon import score_luvizon_results
    from detector.evaluation.report import LuvizonReport
    from labelgen.datasets.luvizon import select_videos

    videos = select_videos(dataset, recordings)
    scored = score_luvizon_results(dataset, results, videos, systems)
    progress = tqdm(scored, total=len(videos) * len(systems), desc="scoring", unit="file", leave=False)
    return LuvizonReport(tuple(progress), tuple(systems), tuple(videos))


def _names(values: Sequence[str]) -> list[str]:
    """Return the names of systems, each once, from values that may hold several with commas between."""
    names = [name.strip() for value in values for name in value.split(",")]
    return list(dict.fromkeys(name.removesuffix(".json").removeprefix("system_") for name in names if name))
