"""Reports of the scores of several systems: data for JSON, tables, and plots. Nothing is printed here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from detector.evaluation.luvizon import ScoredVideo, luvizon_row
from detector.evaluation.plots import plot_cumulative_errors
from detector.evaluation.results_folder import ScoredResult, result_file_name
from detector.evaluation.summary import (
    Value,
    absolute_errors,
    common_only,
    pooled_row,
    recording_row,
    relative_errors,
)
from detector.evaluation.tables import CALIBRATION_COLUMNS, LUVIZON_COLUMNS, SPEED_COLUMNS, TableFormat, format_table

__all__ = ["PLOT_NAMES", "LuvizonReport", "SpeedReport"]

PLOT_NAMES = ("cumulative_absolute.png", "cumulative_relative.png")
"""Files of `SpeedReport.write_plots`."""

Row = dict[str, Value]


@dataclass(frozen=True, eq=False)
class SpeedReport:
    """Scores of systems on recordings of BrnoCompSpeed.

    Args:
        results: by system, the scores of all recordings.
        recordings: names, in order.
        common_recall: whether speed errors are those of only the vehicles that all systems matched.
    """

    results: dict[str, list[ScoredResult]]
    recordings: tuple[str, ...]
    common_recall: bool = False

    @classmethod
    def create(
        cls,
        scored: Iterable[ScoredResult],
        systems: Sequence[str],
        recordings: Sequence[str],
        *,
        common_recall: bool = False,
    ) -> SpeedReport:
        """Collect scores, as `detector.evaluation.results_folder.score_results` yields them.

        Args:
            scored: of all systems on all recordings.
            systems: names, in order.
            recordings: names, in order.
            common_recall: whether to restrict speed errors to the vehicles that all systems matched.

        Raises:
            DataError, CalibrationError: what scoring raises.
        """
        results = list(scored)
        if common_recall:
            results = [result for name in recordings for result in _common([r for r in results if r.recording == name])]
        by_system = {name: [result for result in results if result.system == name] for name in systems}
        return cls(by_system, tuple(recordings), common_recall)

    def rows(self) -> list[Row]:
        """Return one row (`detector.evaluation.summary.recording_row`) per system and recording."""
        return [_recording_row(result) for results in self.results.values() for result in results]

    def pooled(self) -> dict[str, Row]:
        """Return, by system, the row over all vehicles of all recordings."""
        return {name: pooled_row([result.score for result in results]) for name, results in self.results.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, and how many tracks were read and left out, for JSON."""
        return {
            "protocol": "BrnoCompSpeed, median mode",
            "recordings": list(self.recordings),
            "systems": list(self.results),
            "common_recall": self.common_recall,
            "rows": self.rows(),
            "pooled": self.pooled(),
            "tracks": [
                {
                    "recording": result.recording,
                    "system": name,
                    "read": result.score.tracks_read,
                    "dropped": result.score.dropped,
                }
                for name, results in self.results.items()
                for result in results
            ],
        }

    def tables(self, style: TableFormat = TableFormat.TEXT) -> str:
        """Return tables of speed and of calibration errors, pooled rows last. As CSV it is one table of all figures."""
        rows: list[Row] = [
            {"system": result.system, **_recording_row(result)}
            for results in self.results.values()
            for result in results
        ]
        for name, pooled in self.pooled().items():
            first = self.results[name][0]
            head: Row = {
                "system": name,
                "recording": "pooled",
                "tracks": first.tracks,
                "calibration": first.calibration,
            }
            rows.append(head | {key: pooled[key] for key in rows[0] if key not in head})
        if style is TableFormat.CSV:
            return format_table(rows, {}, style)
        return "\n\n".join(format_table(rows, columns, style) for columns in (SPEED_COLUMNS, CALIBRATION_COLUMNS))

    def dropped_tracks(self) -> str:
        """Return one line per system: how many tracks the protocol left out, and why."""
        lines = []
        for name, results in self.results.items():
            dropped: Counter[str] = Counter()
            for result in results:
                dropped.update(result.score.dropped)
            reasons = "; ".join(f"{count} {reason}" for reason, count in dropped.most_common())
            read = sum(result.score.tracks_read for result in results)
            lines.append(f"{name}: {read} tracks read, {dropped.total()} left out{': ' if reasons else ''}{reasons}")
        return "\n".join(lines)

    def write_plots(self, folder: Path) -> None:
        """Write the files of `PLOT_NAMES` into an existing folder.

        Raises:
            OutputError: a file cannot be written.
        """
        for errors, unit, name in zip((absolute_errors, relative_errors), ("km/h", "%"), PLOT_NAMES, strict=True):
            values = {
                system: np.concatenate([errors(result.score) for result in results])
                for system, results in self.results.items()
            }
            plot_cumulative_errors(values, folder / name, unit=unit)


def _common(results: Sequence[ScoredResult]) -> list[ScoredResult]:
    """Restrict the scores of one recording to the vehicles that all systems matched."""
    scores = common_only({result.system: result.score for result in results})
    return [replace(result, score=scores[result.system]) for result in results]


def _recording_row(result: ScoredResult) -> Row:
    return recording_row(result.recording, result.tracks, result.calibration, result.score)


@dataclass(frozen=True, eq=False)
class LuvizonReport:
    """Scores of systems on videos of the Luvizon data set.

    Args:
        results: as `detector.evaluation.luvizon.score_luvizon_results` yields them.
        systems: names, in order.
        videos: names, in order.
    """

    results: tuple[ScoredVideo, ...]
    systems: tuple[str, ...]
    videos: tuple[str, ...]

    def rows(self) -> list[Row]:
        """Return one row (`detector.evaluation.luvizon.luvizon_row`) per video and system."""
        return [
            {
                "system": result.system,
                "recording": result.video,
                "tracks": result.tracks,
                **luvizon_row([result.score]),
            }
            for result in self.results
        ]

    def pooled(self) -> dict[str, Row]:
        """Return, by system, the row over all vehicles of all videos."""
        return {
            name: luvizon_row([result.score for result in self.results if result.system == name])
            for name in self.systems
        }

    def to_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        return {
            "protocol": "Luvizon, error measured - true in [-3, +2] km/h",
            "recordings": list(self.videos),
            "systems": list(self.systems),
            "rows": self.rows(),
            "pooled": self.pooled(),
        }

    def table(self, style: TableFormat = TableFormat.TEXT) -> str:
        """Return one table, pooled rows last."""
        rows = self.rows()
        for name, pooled in self.pooled().items():
            rows.append({"system": name, "recording": "pooled", "tracks": result_file_name(name), **pooled})
        return format_table(rows, LUVIZON_COLUMNS, style)
