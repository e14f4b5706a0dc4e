"""The part of `labelgen evaluate` that scores the Luvizon data set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from detector.evaluation import LuvizonScore, TableFormat

__all__ = ["evaluate_luvizon"]


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
