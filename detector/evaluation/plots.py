"""Plots of the cumulative distribution of speed errors."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np

from labelgen.atomic_files import write_atomic
from labelgen.geometry.homography import Array

__all__ = ["plot_cumulative_errors"]

_TOLERANCE_KMH = 3.0
_STYLES = ("-", "--", "-.", ":")


def plot_cumulative_errors(errors: Mapping[str, Array], path: str | Path, *, unit: str = "km/h") -> None:
    """Plot the share of vehicles whose error is at most x, one curve per system, into a file.

    Args:
        errors: by system, (n,) absolute errors in `unit`; a system without errors stands in the legend only.
        path: picture file in an existing folder; its ending (.png, .pdf, .svg) decides the format.
        unit: "km/h" or "%".

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, PercentFormatter

    figure = Figure(figsize=(7.5, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    top = max((float(values.max()) for values in errors.values() if len(values)), default=1.0)
    low = 0.1
    top = max(top, 10 * low)
    if unit == "km/h":
        axes.axvline(_TOLERANCE_KMH, color="0.6", linewidth=1)
        axes.annotate(
            "3 km/h", (_TOLERANCE_KMH, 0.02), xytext=(4, 0), textcoords="offset points", color="0.4", fontsize=9
        )
    for number, (name, values) in enumerate(errors.items()):
        ordered = np.sort(values)
        share = np.arange(1, len(ordered) + 1) / max(len(ordered), 1)
        # All curves start at the axis and go on to the right border, so that they can be compared there.
        x = np.concatenate([[low / 10], ordered, [top]]) if len(ordered) else np.empty(0)
        y = np.concatenate([[0.0], share, [1.0]]) if len(ordered) else np.empty(0)
        mean = f"mean {values.mean():.2f} {unit}, " if len(values) else ""
        label = f"{name} ({mean}n = {len(values)})"
        axes.step(x, y, where="post", label=label, linestyle=_STYLES[number // 10 % len(_STYLES)], linewidth=1.8)
    axes.set_xscale("log")
    axes.set_xlim(low, top)
    axes.set_ylim(0, 1)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(which="major", linewidth=0.5, alpha=0.5)
    axes.grid(which="minor", axis="x", linewidth=0.4, alpha=0.2)
    axes.set_xlabel(f"absolute speed error up to [{unit}]" if unit == "km/h" else "relative speed error up to [%]")
    axes.set_ylabel("share of matched vehicles")
    if errors:
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1.01), frameon=False, fontsize=9)
    picture = BytesIO()
    figure.savefig(picture, format=Path(path).suffix[1:], dpi=150)
    write_atomic(Path(path), picture.getvalue())
