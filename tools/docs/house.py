"""The house in one picture: the rooms and the arrows between them, from the code's own imports.

    python -m tools.docs.house [--out docs/pictures/house.svg]

Rooms and layers come from the import-linter contract in pyproject.toml, arrows from the imports of all modules. An
arrow is left out where a longer way leads to the same room, so the picture shows what rests on what, not every import.
"""

from __future__ import annotations

import argparse
import re
import tomllib
from pathlib import Path

import grimp
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

__all__ = ["draw_house", "main", "read_layers", "room_imports", "without_shortcuts"]

_SINGLE_FILES = "labelgen: single files"
"""One room in the picture for the small files that every room may use."""
NOTES = {
    "tools": "studies, benchmarks,\npictures; not in the wheel",
    "labelgen.cli": "one file per command",
    "detector": "learns from shards;\nboxes to tracks to km/h; scores",
    "labelgen.synth": "synthetic traffic\nwith exact truth",
    "labelgen.jobs": "resumable work\nthat fills shards",
    "labelgen.audit": "contact sheets,\nfigures, statistics",
    "labelgen.calibration": "camera, scale and road mask\nfrom the video alone",
    "labelgen.labeling": "3D boxes or masks\nof a frame to labels",
    "labelgen.masks": "instance masks:\nnetworks, background, files",
    "labelgen.shards": "the HDF5 format",
    "labelgen.datasets": "BoxCars116k, BrnoCompSpeed,\nLuvizon, your own scene",
    "labelgen.labels": "Labels, Sample",
    "labelgen.media": "frames of videos,\nfolders, streams",
    "labelgen.geometry": "camera, rectification,\nbox codec, c_c from an outline",
    _SINGLE_FILES: "errors, files written whole,\nchoices, progress, drawing",
}
"""What each room is for, in a few words; modules without an entry are drawn as one room."""

_COLORS = {"tools": "#e8e8e8", "detector": "#d6e6f5"}
_COLOR = "#dff0e3"
_BOX_WH = (2.5, 0.78)
_GAP_XY = (0.75, 0.62)
_BENDS = [k / 20 for k in range(-40, 41)]
"""How far an arrow may swing out to the side, as a share of its length."""


def read_layers(pyproject: Path) -> list[str]:
    """Return the modules that the contract of type "layers" names, top layer first."""
    contracts = tomllib.loads(pyproject.read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    return [part.strip(" ()") for layer in layers for part in re.split(r"[:|]", layer)]


def room_imports(modules: list[str]) -> dict[str, set[str]]:
    """Return for each room the rooms below it that its modules import; import-linter refuses the others.

    Args:
        modules: packages and modules of the layers, top first; those without an entry in `NOTES` become one room.
    """
    graph = grimp.build_graph(*sorted({name.split(".")[0] for name in modules}), exclude_type_checking_imports=True)
    imports: dict[str, set[str]] = {_room(name): set() for name in modules}
    rank = {room: number for number, room in enumerate(imports)}
    for importer in graph.modules:
        for imported in graph.find_modules_directly_imported_by(importer):
            ends = [next((m for m in modules if f"{name}.".startswith(f"{m}.")), None) for name in (importer, imported)]
            if ends[0] is not None and ends[1] is not None:
                upper, lower = _room(ends[0]), _room(ends[1])
                if rank[lower] > rank[upper]:
                    imports[upper].add(lower)
    return imports


def _room(module: str) -> str:
    return module if module in NOTES else _SINGLE_FILES


def without_shortcuts(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """Leave out each arrow whose end is also reached over another room (transitive reduction)."""
    reached: dict[str, set[str]] = {}

    def below(room: str) -> set[str]:
        if room not in reached:
            reached[room] = imports[room].union(*(below(target) for target in imports[room]))
        return reached[room]

    return {room: {t for t in ts if not any(t in below(other) for other in ts - {t})} for room, ts in imports.items()}


def draw_house(arrows: dict[str, set[str]]) -> Figure:
    """Draw the rooms in rows, what imports above what is imported, with an arrow from each to what it rests on."""
    rows = _rows(arrows)
    width = max(len(row) for row in rows) * (_BOX_WH[0] + _GAP_XY[0]) + _GAP_XY[0]
    step = _BOX_WH[1] + _GAP_XY[1]
    height = len(rows) * step
    figure = Figure(figsize=(width * 0.9, height * 0.9))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.axis("off")
    places: dict[str, tuple[float, float]] = {}
    for number, row in enumerate(rows):
        y = height - (number + 0.5) * step
        for column, room in enumerate(row):
            places[room] = (width / len(row) * (column + 0.5), y)
    for room, targets in arrows.items():
        for target in sorted(targets):
            _draw_arrow(axes, places[room], places[target], list(places.values()))
    for room, place in places.items():
        _draw_room(axes, room, place)
    return figure


def _rows(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Put each room one row above the highest room that it imports; top row first."""
    heights: dict[str, int] = {}
    for room in reversed(arrows):  # the contract's order has what is imported further down
        heights[room] = max((heights.get(target, -1) for target in arrows[room]), default=-1) + 1
    return [[room for room in arrows if heights[room] == row] for row in range(max(heights.values()), -1, -1)]


def _draw_room(axes: Axes, room: str, center: tuple[float, float]) -> None:
    (x, y), (w, h) = center, _BOX_WH
    box = FancyBboxPatch(
        (x - w / 2, y - h / 2), w, h, boxstyle="round,pad=0,rounding_size=0.08",
        facecolor=_COLORS.get(room.split(".")[0], _COLOR), edgecolor="#5b6b73", linewidth=0.9, zorder=3,
    )  # fmt: skip
    axes.add_patch(box)
    axes.text(x, y + 0.2, room, ha="center", va="center", fontsize=9.5, fontweight="bold", zorder=4)
    axes.text(x, y - 0.12, NOTES.get(room, ""), ha="center", va="center", fontsize=7.6, color="#333333", zorder=4)


def _draw_arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], boxes: list[tuple[float, float]]
) -> None:
    """Draw an arrow from the lower side of one room to the upper side of another, bent around the rooms between."""
    half = _BOX_WH[1] / 2
    shift = float(np.clip((end[0] - start[0]) / 4, -0.9, 0.9))
    tail = np.array([start[0] + shift, start[1] - half])
    head = np.array([end[0] - shift, end[1] + half])
    centers = np.array(boxes)
    across = np.array([-(head - tail)[1], (head - tail)[0]])
    t = np.linspace(0.02, 0.98, 80)[:, None]

    def hits(bend: float) -> int:
        middle = (tail + head) / 2 + bend * across
        curve = (1 - t) ** 2 * tail + 2 * t * (1 - t) * middle + t**2 * head
        inside = np.abs(curve[:, None] - centers[None]) < np.array(_BOX_WH) / 2 + 0.02
        return int(inside.all(axis=2).sum())

    bend = min(_BENDS, key=lambda value: (hits(value), abs(value)))
    arrow = FancyArrowPatch(
        tuple(tail), tuple(head), arrowstyle="-|>", connectionstyle=f"arc3,rad={-bend}", mutation_scale=11,
        linewidth=1.0, color="#7a8790", shrinkA=0, shrinkB=0, zorder=2,
    )  # fmt: skip
    axes.add_patch(arrow)


def main() -> None:
    """Command line of the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/house.svg"))
    parser.add_argument("--pyproject", type=Path, default=Path("pyproject.toml"))
    options = parser.parse_args()
    arrows = without_shortcuts(room_imports(read_layers(options.pyproject)))
    # The same code gives the same bytes.
    matplotlib.rcParams["svg.hashsalt"] = "house"
    metadata = {"Date": None} if options.out.suffix == ".svg" else {}
    draw_house(arrows).savefig(options.out, metadata=metadata, dpi=110)
    print(options.out)


if __name__ == "__main__":
    main()
