"""Tables of scores as aligned text, Markdown and CSV. Imports nothing heavy: the command line reads `TableFormat`."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING

from labelgen.printable import spreadsheet_text

if TYPE_CHECKING:
    from detector.evaluation.summary import Value

__all__ = ["CALIBRATION_COLUMNS", "LUVIZON_COLUMNS", "SPEED_COLUMNS", "Columns", "TableFormat", "format_table"]

Columns = Mapping[str, tuple[str, str]]
"""Key of a row -> heading and number format (empty for text)."""


class TableFormat(StrEnum):
    """Form of a printed table."""

    TEXT = "text"
    MARKDOWN = "markdown"
    CSV = "csv"


_WHERE = {"system": ("system", ""), "recording": ("recording", "")}

SPEED_COLUMNS: Columns = _WHERE | {
    "n": ("n", "d"),
    "mean": ("mean km/h", ".2f"),
    "median": ("median", ".2f"),
    "p95": ("p95", ".2f"),
    "worst": ("worst", ".2f"),
    "mean_relative": ("mean %", ".2f"),
    "median_relative": ("median %", ".2f"),
    "p95_relative": ("p95 %", ".2f"),
    "recall": ("recall", ".3f"),
    "precision": ("precision", ".3f"),
    "false_positives": ("false pos.", "d"),
    "intersection_failures": ("failures", "d"),
}
LUVIZON_COLUMNS: Columns = _WHERE | {
    "vehicles": ("vehicles", "d"),
    "matched": ("matched", "d"),
    "recall": ("recall", ".3f"),
    "within_matched": ("in [-3, +2]", ".3f"),
    "within_all": ("of all", ".3f"),
    "within_matched_public": ("in [-2, +3]", ".3f"),
    "within_all_public": ("of all", ".3f"),
    "bias": ("bias km/h", "+.2f"),
    "mean": ("mean", ".2f"),
    "median": ("median", ".2f"),
    "p95": ("p95", ".2f"),
    "worst": ("worst", ".2f"),
}
CALIBRATION_COLUMNS: Columns = _WHERE | {
    "calibration": ("calibration", ""),
    "calibration_ratio_error_absolute_mean": ("ratio error", ".4f"),
    "calibration_ratio_error_relative_mean": ("ratio error %", ".2f"),
    "distance_error_m_mean": ("distance error m", ".3f"),
    "distance_error_relative_mean": ("distance error %", ".2f"),
}


def format_table(rows: Sequence[Mapping[str, Value]], columns: Columns, style: TableFormat = TableFormat.TEXT) -> str:
    """Return rows as one table, without a newline at the end.

    Args:
        rows: all with the same keys. A figure that is None becomes a dash, in CSV an empty cell.
        columns: what text and Markdown show, of the keys that the rows have. CSV holds all keys and all digits.
        style: form of the table.

    Returns:
        the table; empty without rows.
    """
    if not rows:
        return ""
    if style is TableFormat.CSV:
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(rows[0])
        writer.writerows([_csv_cell(row[key]) for key in rows[0]] for row in rows)
        return buffer.getvalue().rstrip("\n")
    shown = {key: column for key, column in columns.items() if key in rows[0]}
    table = [[heading, *(_cell(row[key], form) for row in rows)] for key, (heading, form) in shown.items()]
    padded, rules = [], []
    for cells, (_, form) in zip(table, shown.values(), strict=True):
        width = max(map(len, cells))
        padded.append([cell.rjust(width) if form else cell.ljust(width) for cell in cells])
        rules.append("-" * (width - 1) + (":" if form and style is TableFormat.MARKDOWN else "-"))
    lines = list(zip(*padded, strict=True))
    lines.insert(1, tuple(rules))
    if style is TableFormat.TEXT:
        return "\n".join("  ".join(line).rstrip() for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _csv_cell(value: Value) -> Value:
    return spreadsheet_text(value) if isinstance(value, str) else value


def _cell(value: Value, number_format: str) -> str:
    if value is None:
        return "-"
    return format(value, number_format) if number_format else str(value).replace("|", "\\|")
