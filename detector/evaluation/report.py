"""The part of `labelgen evaluate` that scores BrnoCompSpeed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from detector.evaluation import LuvizonScore, TableFormat

if TYPE_CHECKING:
    from detector.evaluation import RecordingScore, ScoredResult, TableFormat

__all__ = ["evaluate_brnocompspeed", "evaluate_luvizon"]


def evaluate_brnocompspeed(
    dataset: Path,
    results: Path,
    systems: Sequence[str],
    choice: str,
    calibration: str,
    *,
    common: bool,
    plots: Path | None,
    style: TableFormat,
) -> dict[str, Any]:
    """Score systems on recordings, print the tables, write the plots, return what `--json` holds.

    Raises:
        DataError, CalibrationError, OutputError: a file is missing, not of its format, or cannot be written.
    """
    from tqdm import tqdm

    from detector.evaluation import TableFormat, score_results, select_recordings, split_c_test
    from labelgen.atomic_files import make_folder

    recordings = select_recordings(dataset, choice)
    missing = [name for name in split_c_test() if name not in recordings]
    if choice.lower() == "split-c" and missing:
        typer.echo(f"note: of split C's test recordings these are not in {dataset}: {', '.join(missing)}", err=True)
    scored = score_results(dataset, results, recordings, systems, calibration)
    parts = list(tqdm(scored, total=len(recordings) * len(systems), desc="scoring", unit="file", leave=False))
    if common:
        parts = _common(parts, recordings)
    by_system = {name: [part for part in parts if part.system == name] for name in systems}
    summary = _summary(by_system, recordings, common)

    typer.echo(_tables(by_system, summary["pooled"], style))
    if style is TableFormat.TEXT:
        typer.echo(_losses(by_system))
    if plots is not None:
        _plot(by_system, make_folder(plots))
        typer.echo(f"plots: {plots}", err=True)
    return summary


def _common(parts: Sequence[ScoredResult], recordings: Sequence[str]) -> list[ScoredResult]:
    from dataclasses import replace

    from detector.evaluation import common_only

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
    from detector.evaluation import pooled_row

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
    from detector.evaluation import recording_row

    return recording_row(part.recording, part.tracks, part.calibration, part.score)


def _tables(
    by_system: Mapping[str, Sequence[ScoredResult]], pooled: Mapping[str, Mapping[str, Any]], style: TableFormat
) -> str:
    """One line per recording and system, then the pooled ones."""
    from detector.evaluation import CALIBRATION_COLUMNS, SPEED_COLUMNS, TableFormat, format_table

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

    from detector.evaluation import absolute_errors, relative_errors
    from detector.evaluation.plots import plot_cumulative_errors

    for errors, unit, name in ((absolute_errors, "km/h", "absolute"), (relative_errors, "%", "relative")):
        values = {system: np.concatenate([errors(part.score) for part in parts]) for system, parts in by_system.items()}
        plot_cumulative_errors(values, folder / f"cumulative_{name}.png", unit=unit)


def evaluate_luvizon(
    dataset: Path, results: Path, systems: Sequence[str], choice: str, style: TableFormat
) -> dict[str, Any]:
    """Score systems on videos, print the table, return what `--json` holds.

    A system's file for a video is RESULTS/subset01/video01/system_NAME.json, in the public result format; its
    `camera_calibration` may hold `lane_scales`, three factors on top of `scale`.

    Raises:
        DataError, CalibrationError: a file is missing or not of its format.
    """
    from tqdm import tqdm

    from detector.evaluation import (
        LUVIZON_COLUMNS,
        format_table,
        luvizon_row,
        read_luvizon_video,
        read_results,
        score_luvizon,
        select_videos,
    )
    from detector.evaluation.results_folder import result_file_name

    scores: dict[str, list[LuvizonScore]] = {system: [] for system in systems}
    rows: list[dict[str, Any]] = []
    names = select_videos(dataset, choice)
    for name in tqdm(names, desc="scoring", unit="video", leave=False):
        video = read_luvizon_video(dataset / name)
        for system in systems:
            file = read_results(results / name / result_file_name(system))
            score = score_luvizon(video, file.tracks, file.camera(), file.lane_scales())
            scores[system].append(score)
            rows.append({"system": system, "recording": name, "tracks": file.path.name, **luvizon_row([score])})
    pooled = {system: luvizon_row(parts) for system, parts in scores.items()}
    last: list[dict[str, Any]] = [
        {"system": system, "recording": "pooled", "tracks": result_file_name(system), **row}
        for system, row in pooled.items()
    ]
    typer.echo(format_table(rows + last, LUVIZON_COLUMNS, style))
    return {
        "protocol": "Luvizon, error measured - true in [-3, +2] km/h",
        "recordings": names,
        "systems": list(systems),
        "rows": rows,
        "pooled": pooled,
    }
