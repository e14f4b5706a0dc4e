"""`labelgen evaluate`: score speeds by the public protocol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from detector.score.tables import CALIBRATION_COLUMNS, SPEED_COLUMNS, TableFormat, format_table

if TYPE_CHECKING:
    from detector.score import RecordingScore, ScoredResult

__all__ = ["evaluate"]


def evaluate(
    dataset: Annotated[Path, typer.Option(metavar="DIR", help="Folder with sessionN_left/gt_data.pkl and so on.")],
    results: Annotated[Path, typer.Option(metavar="DIR", help="Folder with sessionN_left/system_NAME.json.")],
    system: Annotated[list[str], typer.Option(metavar="NAME...", help="System to score; several to compare.")],
    more_systems: Annotated[list[str] | None, typer.Argument(hidden=True)] = None,
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
    table: Annotated[TableFormat, typer.Option("--format", help="How to print the tables.")] = TableFormat.TEXT,
) -> None:
    """Score tracks against the BrnoCompSpeed ground truth, by the public protocol.

    Speed errors of the matched, valid vehicles (median of a track's speeds over 5 points), recall, false positives,
    calibration and distance errors, for each recording and pooled over all vehicles. Precision, which the public
    script does not have, is matched / (matched + false positives).
    """
    from tqdm import tqdm

    from detector.score import missing_recordings, score_results, select_recordings
    from labelgen.files import make_folder, write_json

    systems = _names([*system, *(more_systems or [])])
    chosen = select_recordings(dataset, recordings)
    missing = missing_recordings(recordings, chosen)
    if missing:
        typer.echo(f"note: of split C's test recordings these are not in {dataset}: {', '.join(missing)}", err=True)
    scored = score_results(dataset, results, chosen, systems, calibration)
    parts = list(tqdm(scored, total=len(chosen) * len(systems), desc="scoring", unit="file", leave=False))
    if common_recall:
        parts = _common(parts, chosen)
    by_system = {name: [part for part in parts if part.system == name] for name in systems}
    summary = _summary(by_system, chosen, common_recall)

    typer.echo(_tables(by_system, summary["pooled"], table))
    if table is TableFormat.TEXT:
        typer.echo(_losses(by_system))
    if plots is not None:
        _plot(by_system, make_folder(plots))
        typer.echo(f"plots: {plots}", err=True)
    if json_file is not None:
        write_json(json_file, summary)


def _names(values: Sequence[str]) -> list[str]:
    """Systems by name, however many an option holds, each once."""
    names = [name.strip() for value in values for name in value.split(",")]
    return list(dict.fromkeys(name.removesuffix(".json").removeprefix("system_") for name in names if name))


def _common(parts: Sequence[ScoredResult], recordings: Sequence[str]) -> list[ScoredResult]:
    from dataclasses import replace

    from detector.score import common_only

    out = []
    for recording in recordings:
        here = [part for part in parts if part.recording == recording]
        scores = common_only({part.system: part.score for part in here})
        out += [replace(part, score=scores[part.system]) for part in here]
    return out


def _summary(
    by_system: Mapping[str, Sequence[ScoredResult]], recordings: Sequence[str], common: bool
) -> dict[str, Any]:
    """What `--json` holds."""
    from detector.score import pooled_row

    return {
        "protocol": "BrnoCompSpeed, median mode",
        "recordings": list(recordings),
        "systems": list(by_system),
        "common_recall": common,
        "rows": [_row(part) for parts in by_system.values() for part in parts],
        "pooled": {name: pooled_row([part.score for part in parts]) for name, parts in by_system.items()},
        "tracks": [
            {"recording": part.recording, "system": name, "read": part.score.tracks_read, "dropped": part.score.dropped}
            for name, parts in by_system.items()
            for part in parts
        ],
    }


def _row(part: ScoredResult) -> dict[str, Any]:
    from detector.score import recording_row

    return recording_row(part.recording, part.tracks, part.calibration, part.score)


def _tables(
    by_system: Mapping[str, Sequence[ScoredResult]], pooled: Mapping[str, Mapping[str, Any]], style: TableFormat
) -> str:
    """One line per recording and system, then the pooled ones."""
    rows = [{"system": part.system, **_row(part)} for parts in by_system.values() for part in parts]
    for name, parts in by_system.items():
        last = {"system": name, "recording": "pooled", "tracks": parts[0].tracks, "calibration": parts[0].calibration}
        rows.append(last | {key: pooled[name][key] for key in rows[0] if key not in last})
    if style is TableFormat.CSV:
        return format_table(rows, {}, style)
    return "\n\n".join(format_table(rows, columns, style) for columns in (SPEED_COLUMNS, CALIBRATION_COLUMNS))


def _losses(by_system: Mapping[str, Sequence[ScoredResult]]) -> str:
    """How many tracks the protocol left out, and why."""
    lines = [""]
    for name, parts in by_system.items():
        scores: list[RecordingScore] = [part.score for part in parts]
        reasons: dict[str, int] = {}
        for score in scores:
            for reason, count in score.dropped.items():
                reasons[reason] = reasons.get(reason, 0) + count
        why = "; ".join(f"{count} {reason}" for reason, count in sorted(reasons.items(), key=lambda item: -item[1]))
        read = sum(score.tracks_read for score in scores)
        lines.append(f"{name}: {read} tracks read, {sum(reasons.values())} left out{': ' if why else ''}{why}")
    return "\n".join(lines)


def _plot(by_system: Mapping[str, Sequence[ScoredResult]], folder: Path) -> None:
    import numpy as np

    from detector.score import absolute_errors, relative_errors
    from detector.score.plots import plot_cumulative_errors

    for errors, unit, name in ((absolute_errors, "km/h", "absolute"), (relative_errors, "%", "relative")):
        values = {system: np.concatenate([errors(part.score) for part in parts]) for system, parts in by_system.items()}
        plot_cumulative_errors(values, folder / f"cumulative_{name}.png", unit=unit)
