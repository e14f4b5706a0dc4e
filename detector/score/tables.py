"""Tables of scores as aligned text, Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from enum import Enum

from detector.score.summary import Value

__all__ = ["COLUMNS", "TableFormat", "format_table"]


class TableFormat(str, Enum):
    """How to print a table."""

    TEXT = "text"
    MARKDOWN = "markdown"
    CSV = "csv"


COLUMNS: dict[str, tuple[str, str]] = {
    "system": ("system", ""),
    "recording": ("recording", ""),
    "n": ("n", "d"),
    "mean": ("mean km/h", ".3f"),
    "median": ("median km/h", ".3f"),
    "p95": ("95% km/h", ".3f"),
    "worst": ("worst km/h", ".2f"),
    "mean_relative": ("mean %", ".2f"),
    "median_relative": ("median %", ".2f"),
    "p95_relative": ("95% %", ".2f"),
    "recall": ("recall", ".4f"),
    "precision": ("precision", ".4f"),
    "false_positives": ("false pos.", "d"),
    "intersection_failures": ("failures", "d"),
    "calibration_ratio_error_relative_mean": ("ratio err %", ".2f"),
    "distance_error_m_mean": ("dist err m", ".3f"),
    "distance_error_relative_mean": ("dist err %", ".2f"),
}
"""Keys of rows shown to people: heading and number format. CSV holds all keys and all digits."""


def format_table(rows: Sequence[Mapping[str, Value]], style: TableFormat = TableFormat.TEXT) -> str:
    """Rows as one table, without a newline at the end; figures that are not known are dashes (CSV: empty).

    Text and Markdown show those of `COLUMNS` that the first row has; CSV shows all keys of the first row.
    """
    if not rows:
        return ""
    if style is TableFormat.CSV:
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(rows[0])
        writer.writerows([row[key] for key in rows[0]] for row in rows)
        return buffer.getvalue().rstrip("\n")
    keys = [key for key in COLUMNS if key in rows[0]]
    cells = [[COLUMNS[key][0] for key in keys]]
    cells += [[_cell(row[key], COLUMNS[key][1]) for key in keys] for row in rows]
    widths = [max(len(line[column]) for line in cells) for column in range(len(keys))]
    numeric = [bool(COLUMNS[key][1]) for key in keys]
    lines = [
        [cell.rjust(width) if number else cell.ljust(width) for cell, width, number in zip(line, widths, numeric)]
        for line in cells
    ]
    if style is TableFormat.TEXT:
        return "\n".join("  ".join(line).rstrip() for line in [lines[0], ["-" * w for w in widths], *lines[1:]])
    rule = ["-" * (width - 1) + ":" if number else "-" * width for width, number in zip(widths, numeric)]
    return "\n".join(f"| {' | '.join(line)} |" for line in [lines[0], rule, *lines[1:]])


def _cell(value: Value, number_format: str) -> str:
    if value is None:
        return "-"
    return format(value, number_format) if number_format else str(value).replace("|", "\\|")
