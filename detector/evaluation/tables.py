"""Tables of scores as aligned text, Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from enum import StrEnum

from detector.evaluation.summary import Value
from labelgen.errors import DataError

__all__ = ["CALIBRATION_COLUMNS", "LUVIZON_COLUMNS", "SPEED_COLUMNS", "Columns", "TableFormat", "format_table"]

Columns = Mapping[str, tuple[str, str]]
"""Key of a row -> heading and number format (empty for text)."""


class TableFormat(StrEnum):
    """How to print a table."""

    TEXT = "text"
    MARKDOWN = "markdown"
    CSV = "csv"

    @classmethod
    def parse(cls, text: str) -> TableFormat:
        """A format by its name; DataError where there is none of that name."""
        try:
            return cls(text)
        except ValueError:
            raise DataError(f"table format {text!r}: expected {', '.join(cls)}") from None


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
    """Rows as one table, without a newline at the end; figures that are not known are dashes (CSV: empty).

    Text and Markdown show the given columns as far as the first row has them, CSV all keys and digits.
    """
    if not rows:
        return ""
    if style is TableFormat.CSV:
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(rows[0])
        writer.writerows([row[key] for key in rows[0]] for row in rows)
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


def _cell(value: Value, number_format: str) -> str:
    if value is None:
        return "-"
    return format(value, number_format) if number_format else str(value).replace("|", "\\|")
