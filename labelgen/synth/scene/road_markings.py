"""Paint and wear on the lanes as a map from above: arrows, words, crossings, patches, cracks, joints, stains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.scene.scene import LANE_WIDTH, RoadScene, carriageways

__all__ = ["Surface", "draw_surface"]

_CELL = 0.05
"""Side of a map cell, metres."""
_LENGTH_M = 140.0
"""Length of the map along the road, metres."""
Plane = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Surface:
    """Paint and wear on the lanes.

    Args:
        levels: (h, w, 2) uint8 each, every level half as long as the one before: share of paint, 255 for all; and tone,
            128 for plain asphalt.
        low_y: metres, y of the map's first row.
    """

    levels: list[NDArray[np.uint8]]
    low_y: float

    def at(self, x: Plane, y: Plane, footprint: Plane) -> tuple[Plane, Plane]:
        """Return the share of paint and the factor on the asphalt at places on the road.

        Args:
            x, y: (h, w) metres.
            footprint: (h, w) metres that a sample covers; their median picks the level.
        """
        level = int(np.clip(np.log2(max(float(np.median(footprint)) * 5 / _CELL, 1.0)), 0, len(self.levels) - 1))
        plane = self.levels[level]
        column = (x * np.float32(1 / (_CELL * 2**level))).astype(np.int32)
        row = ((y - np.float32(self.low_y)) * np.float32(1 / _CELL)).astype(np.int32)
        inside = (column >= 0) & (row >= 0) & (column < plane.shape[1]) & (row < plane.shape[0])
        cells = plane[np.where(inside, row, 0), np.where(inside, column, 0)].astype(np.float32)
        paint = np.where(inside, cells[..., 0] / 255, np.float32(0))
        return paint, np.where(inside, cells[..., 1] / 128, np.float32(1))


class _Sheet:
    """A map of paint and one of tone to draw on, in metres."""

    def __init__(self, low_y: float, high_y: float) -> None:
        self.low_y = low_y
        shape = (int((high_y - low_y) / _CELL), int(_LENGTH_M / _CELL))
        self.paint, self.tone = np.zeros(shape, np.uint8), np.full(shape, 128, np.uint8)

    def pixels(self, points: Any) -> NDArray[np.int32]:
        at = (np.asarray(points, dtype=np.float64).reshape(-1, 2) - [0, self.low_y]) / _CELL
        return np.asarray(np.round(at * 16), dtype=np.int32)

    def polygon(self, plane: NDArray[np.uint8], points: Any, value: float) -> None:
        cv2.fillPoly(plane, [self.pixels(points)], value, cv2.LINE_AA, 4)

    def rectangle(self, plane: NDArray[np.uint8], low: Any, high: Any, value: float) -> None:
        (x0, y0), (x1, y1) = low, high
        self.polygon(plane, [(x0, y0), (x1, y0), (x1, y1), (x0, y1)], value)

    def line(self, plane: NDArray[np.uint8], points: Any, value: float, width: float) -> None:
        thick = max(1, round(width / _CELL))
        cv2.polylines(plane, [self.pixels(points)], False, value, thick, cv2.LINE_AA, 4)


def _arrow(sheet: _Sheet, x: float, y: float, heading: int, kind: int) -> None:
    """Draw a lane arrow 5 m long: straight on, or with a bend to one side."""
    stem = [(0, -0.08), (2.6, -0.08), (2.6, 0.08), (0, 0.08)]
    tip = [(2.6, -0.35), (5.0, 0), (2.6, 0.35)]
    bend = [(1.4, 0.06), (2.6, 0.55), (2.3, 0.75), (4.0, 0.95), (3.2, 0.25), (2.9, 0.40), (1.9, -0.06)]
    shapes = [[stem, tip], [[*stem[:1], (1.9, -0.08), (1.9, 0.08), (0, 0.08)], bend], [stem, tip, bend]][kind]
    for shape in shapes:
        points = np.array(shape) * [heading, heading * (1 if kind != 1 else -1)] + [x, y]
        sheet.polygon(sheet.paint, points, 235)


def _word(sheet: _Sheet, x: float, y: float, heading: int, rng: np.random.Generator) -> None:
    """Draw a word or a number, stretched along the road."""
    text = str(rng.choice(["BUS", "50", "SLOW", "TAXI", "70", "STOP", "A6"]))
    (wide, tall), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 2.0, 8)
    page: Any = np.zeros((tall + 20, wide + 20), np.uint8)
    cv2.putText(page, text, (10, tall + 10), cv2.FONT_HERSHEY_SIMPLEX, 2.0, 235, 8, cv2.LINE_AA)
    page = cv2.resize(page, (int(2.4 / _CELL), int(4.0 / _CELL)), interpolation=cv2.INTER_AREA)
    # The driver reads it: its top lies ahead, its left on the driver's left.
    turned = np.rot90(page, -1 if heading > 0 else 1)[::-1]
    column, row = int(x / _CELL), int((y - sheet.low_y - 1.2) / _CELL)
    part = sheet.paint[max(row, 0) : row + turned.shape[0], column : column + turned.shape[1]]
    np.maximum(part, turned[: part.shape[0], : part.shape[1]], out=part)


def _wear(sheet: _Sheet, low: float, high: float, rng: np.random.Generator) -> None:
    """Draw patches, filled cracks, joints, manholes, stains and tyre marks on one carriageway."""
    tone = sheet.tone
    for _ in range(int(rng.integers(0, 7))):
        x, y = rng.uniform(0, 120), rng.uniform(low, high - 1)
        size = rng.uniform([1.0, 0.8], [14.0, 3.0])
        sheet.rectangle(tone, (x, y), (x + size[0], min(y + size[1], high)), float(rng.uniform(90, 150)))
    if rng.random() < 0.3:
        for x in np.arange(rng.uniform(0, 5), 140, rng.uniform(4, 12)).tolist():
            sheet.line(tone, [(x, low), (x, high)], 85, 0.05)
    for _ in range(int(rng.integers(0, 9))):
        steps = np.cumsum(rng.normal([1.2, 0.0], [0.5, 0.25], (int(rng.integers(4, 14)), 2)), axis=0)
        start = np.array([rng.uniform(0, 90), rng.uniform(low, high)])
        sheet.line(tone, steps + start, float(rng.uniform(55, 100)), 0.06)
    for _ in range(int(rng.integers(0, 4))):
        centre = sheet.pixels([(rng.uniform(5, 80), rng.uniform(low, high))])[0] // 16
        cv2.circle(tone, (int(centre[0]), int(centre[1])), int(0.35 / _CELL), 80, -1, cv2.LINE_AA)
    for _ in range(int(rng.integers(0, 5))):
        x, y = rng.uniform(0, 100), rng.uniform(low, high)
        for side in (-0.75, 0.75):
            sheet.line(tone, [(x, y + side), (x + rng.uniform(4, 20), y + side)], 95, 0.2)


def draw_surface(scene: RoadScene, rng: np.random.Generator) -> Surface:
    """Draw the paint and wear on the lanes of a made-up scene; `rng` decides everything."""
    ways = carriageways(scene)
    sheet = _Sheet(min(w[0] for w in ways) - 4, max(w[1] for w in ways) + 4)
    for low, high, inner in ways:
        _wear(sheet, low, high, rng)
        lanes = [low, *inner]
        heading = next(lane.heading for lane in scene.lanes if low < lane.y0 < high)
        if rng.random() < 0.45:
            for x in np.arange(rng.uniform(8, 40), 110, rng.uniform(25, 60)).tolist():
                for left in lanes:
                    _arrow(sheet, x, left + LANE_WIDTH / 2, heading, int(rng.integers(3)))
        if rng.random() < 0.25:
            _word(sheet, rng.uniform(8, 60), float(rng.choice(lanes)) + LANE_WIDTH / 2, heading, rng)
        if rng.random() < 0.18:
            x = rng.uniform(18, 70)
            for y in np.arange(low + 0.2, high - 0.4, 1.0).tolist():
                sheet.rectangle(sheet.paint, (x, y), (x + 3.2, y + 0.5), 225)
        if rng.random() < 0.2:
            x, y = rng.uniform(10, 60), high if rng.random() < 0.5 else low - 1.4
            for k in range(12):
                at = x + 1.6 * k
                sheet.polygon(sheet.paint, [(at, y), (at + 0.4, y), (at + 1.4, y + 1.4), (at + 1.0, y + 1.4)], 215)
    levels: list[Any] = [np.stack([cv2.GaussianBlur(p, (0, 0), 0.7) for p in (sheet.paint, sheet.tone)], axis=-1)]
    for _ in range(4):
        wide = levels[-1]
        half = cv2.resize(wide, (wide.shape[1] // 2, wide.shape[0]), interpolation=cv2.INTER_AREA)
        levels.append(cv2.GaussianBlur(half, (1, 3), 0))
    return Surface(levels, sheet.low_y)
