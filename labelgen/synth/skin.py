"""What is painted on a body: windows, lamps, seams, plates, wheels.

A skin is one image that holds several drawings of the vehicle, one per `Chart`, each an orthographic view.
Colours are linear light square-rooted to 8 bit; the fourth channel is the material of `raster`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.bodies import cabin_edge, shell_end, top_line
from labelgen.synth.mesh import Chart
from labelgen.synth.raster import CHROME, GLASS, LAMP, LIT, MATTE, PAINT, PLATE
from labelgen.synth.shapes import Shape

__all__ = ["Skin", "draw_skin"]

PPM = 96
"""Skin pixels per metre."""

Colour = tuple[float, float, float]
_BLACK: Colour = (0.012, 0.012, 0.013)
_TRIM: Colour = (0.03, 0.03, 0.032)
_GLASS: Colour = (0.012, 0.015, 0.016)
_SEAM = 0.35


class Skin:
    """The image, and where each chart lies in it.

    Args:
        extent_lwh: metres, the mesh's bounding cuboid.
    """

    def __init__(self, extent_lwh: Sequence[float]) -> None:
        length, width, height = extent_lwh
        wide = int(np.ceil(max(length, width) * PPM)) + 2
        rows = [height, width, height, height, height, 0.1, 0.1]
        tops = np.cumsum([0] + [int(np.ceil(r * PPM)) + 2 for r in rows])
        self.image = np.zeros((tops[-1], wide, 4), dtype=np.uint8)
        self.maps = np.zeros((len(Chart), 2, 4))
        self._tops, self._height, self._width = tops, height, width
        self._levels: list[tuple[NDArray[np.uint8], NDArray[np.float64]]] = []
        for chart in (Chart.SIDE, Chart.WHEEL):
            self.maps[chart] = [[-1, 0, 0, length / 2], [0, 0, -1, height]]
        self.maps[Chart.TOP] = [[-1, 0, 0, length / 2], [0, -1, 0, width / 2]]
        self.maps[Chart.FRONT] = [[0, 1, 0, width / 2], [0, 0, -1, height]]
        self.maps[Chart.REAR] = [[0, -1, 0, width / 2], [0, 0, -1, height]]
        self.maps *= PPM
        self.maps[:, 1, 3] += tops[:-1]

    def _pixels(self, chart: Chart, points: Any) -> NDArray[np.int32]:
        p = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if chart is Chart.TOP:
            u, v = p[:, 0], self._width / 2 - p[:, 1]
        elif chart in (Chart.FRONT, Chart.REAR):
            u, v = p[:, 0] + self._width / 2, self._height - p[:, 1]
        else:
            u, v = p[:, 0], self._height - p[:, 1]
        pixels = np.stack([u * PPM, v * PPM], axis=1)
        return np.round(pixels * 16 - 8).astype(np.int32)

    def _view(self, chart: Chart) -> NDArray[np.uint8]:
        return self.image[self._tops[chart] : self._tops[chart + 1]]

    def fill(self, chart: Chart, colour: Colour, material: int) -> None:
        """Paint a whole chart."""
        self._view(chart)[:] = _texel(colour, material)

    def polygon(self, chart: Chart, points: Any, colour: Colour, material: int) -> None:
        """Paint a polygon. Points: (d, z) on the sides, (d, y) on top, (y, z) at the ends, y to the viewer's right."""
        view = np.ascontiguousarray(self._view(chart))
        cv2.fillPoly(view, [self._pixels(chart, points)], _texel(colour, material), cv2.LINE_8, 4)
        self._view(chart)[:] = view

    def circle(self, chart: Chart, centre: Sequence[float], radius: float, colour: Colour, material: int) -> None:
        """Paint a disc."""
        angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        ring = np.stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)], axis=1)
        self.polygon(chart, ring, colour, material)

    def rectangle(
        self, chart: Chart, low: Sequence[float], high: Sequence[float], colour: Colour, material: int
    ) -> None:
        """Paint an axis-aligned rectangle."""
        (x0, y0), (x1, y1) = low, high
        self.polygon(chart, [(x0, y0), (x1, y0), (x1, y1), (x0, y1)], colour, material)

    def line(self, chart: Chart, points: Any, colour: Colour, material: int, width: float = 0.012) -> None:
        """Paint a line of a width in metres."""
        view = np.ascontiguousarray(self._view(chart))
        thick = max(1, round(width * PPM))
        cv2.polylines(view, [self._pixels(chart, points)], False, _texel(colour, material), thick, cv2.LINE_8, 4)
        self._view(chart)[:] = view

    def level(self, metres_per_px: float) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """The image and the charts' maps at a resolution that suits pixels of this size: finer would flicker."""
        if not self._levels:
            self._levels.append((self.image, self.maps))
            for _ in range(4):
                image, maps = self._levels[-1]
                size = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
                half: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
                # Materials do not mix.
                half[..., 3] = image[: 2 * size[1] : 2, : 2 * size[0] : 2, 3]
                self._levels.append((half, maps / 2))
        number = int(np.clip(np.floor(np.log2(max(metres_per_px * PPM, 1.0)) + 0.6), 0, 4))
        return self._levels[number]


def _texel(colour: Colour, material: int) -> tuple[int, int, int, int]:
    r, g, b = (round(255 * float(np.sqrt(min(max(c, 0), 1)))) for c in colour)
    return r, g, b, material


def _rounded(points: Any, share: float = 0.12) -> NDArray[np.float64]:
    """A closed polygon with its corners cut twice, as glass and lamps have them."""
    ring = np.asarray(points, dtype=np.float64)
    for cut in (share, 0.25):
        ahead = np.roll(ring, -1, axis=0) - ring
        ring = np.stack([ring + cut * ahead, ring + (1 - cut) * ahead], axis=1).reshape(-1, 2)
    return ring


def _dim(colour: Colour, factor: float) -> Colour:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


def draw_skin(
    shape: Shape, extent_lwh: Sequence[float], paint: Colour, cargo: Colour, rng: np.random.Generator, *, lamps: bool
) -> Skin:
    """The skin of one vehicle.

    Args:
        shape: its proportions.
        extent_lwh: metres, its mesh's bounding cuboid.
        paint, cargo: linear RGB.
        rng: decides plates, trim and wheels.
        lamps: whether its lamps are on.
    """
    skin = Skin(extent_lwh)
    for chart in (Chart.SIDE, Chart.TOP, Chart.FRONT, Chart.REAR):
        skin.fill(chart, paint, PAINT)
    skin.fill(Chart.DARK, (0.008, 0.008, 0.008), MATTE)
    mirror = paint if rng.random() < 0.75 else _TRIM
    skin.fill(Chart.MIRROR, mirror, PAINT)
    _draw_side(skin, shape, paint, rng)
    _draw_top(skin, shape, paint, rng)
    _draw_front(skin, shape, paint, rng, lamps)
    _draw_rear(skin, shape, paint, rng, lamps)
    _draw_wheels(skin, shape, rng)
    if shape.cargo is not None:
        _draw_cargo(skin, shape, cargo, rng, lamps)
    return skin


def _draw_side(skin: Skin, shape: Shape, paint: Colour, rng: np.random.Generator) -> None:
    end = shell_end(shape)
    seam = _dim(paint, _SEAM)
    skin.rectangle(Chart.SIDE, (0, 0), (shape.length, shape.clearance + 0.07), _TRIM, MATTE)
    d, z = top_line(shape)
    sill, frame = shape.belt + 0.02, 0.075
    inside = (z - frame > sill) & (d > shape.cowl[0]) & (d < shape.rear_window[0])
    inside &= z - frame > sill + 0.02
    first = shape.cowl[0] + 0.20 * (shape.roof_front[0] - shape.cowl[0]) + 0.10
    last = shape.roof_rear[0] + 0.45 * (shape.rear_window[0] - shape.roof_rear[0])
    if shape.kind == "van":
        last = shape.roof_front[0] + 0.75
    elif shape.cargo is not None:
        last = shape.roof_rear[0] - 0.25
    inside &= (d > first) & (d < last)
    if inside.sum() > 4:
        outline = np.concatenate([np.stack([d, z - frame], 1)[inside], [[d[inside][-1], sill], [d[inside][0], sill]]])
        skin.polygon(Chart.SIDE, outline, _BLACK, MATTE)
        inner = outline + np.where(outline[:, 1:] > sill, [[0, -0.025]], [[0, 0.012]])
        skin.polygon(Chart.SIDE, inner, _GLASS, GLASS)
        low, high = d[inside][0], d[inside][-1]
        pillars = np.linspace(low + 0.1, high, shape.doors + 1)[1:-1]
        for p in pillars:
            skin.rectangle(Chart.SIDE, (p - 0.05, sill), (p + 0.05, shape.height), _BLACK, MATTE)
        _repaint_roof_band(skin, d, z, frame, paint)
        if shape.kind != "bus":
            for p in [low + 0.05, *pillars[:2], min(high, pillars[-1] + 1.0) if len(pillars) else high]:
                skin.line(Chart.SIDE, [(p, sill), (p, shape.clearance + 0.16)], seam, PAINT)
            skin.line(Chart.SIDE, [(low, shape.clearance + 0.16), (high, shape.clearance + 0.16)], seam, PAINT)
            for p in [*pillars[:2], high - 0.1]:
                handle = (_dim(paint, 0.7), PAINT) if rng.random() < 0.7 else (_TRIM, MATTE)
                skin.rectangle(Chart.SIDE, (p - 0.24, shape.belt - 0.12), (p - 0.08, shape.belt - 0.09), *handle)
    waist = shape.belt - 0.30
    skin.line(Chart.SIDE, [(0.7, waist), (end - 0.4, waist + 0.05)], _dim(paint, 0.8), PAINT, 0.015)
    for axle in shape.axles:
        skin.circle(Chart.SIDE, (axle, shape.wheel), shape.wheel * 1.17, (0.006, 0.006, 0.006), MATTE)
    lamp_z = shape.nose - 0.12
    skin.polygon(
        Chart.SIDE, [(0, lamp_z - 0.08), (0, lamp_z + 0.09), (0.38, lamp_z + 0.10), (0.25, lamp_z - 0.02)],
        (0.45, 0.45, 0.45), LAMP,
    )  # fmt: skip
    if shape.cargo is None:
        tail = shape.tail - 0.06
        skin.rectangle(Chart.SIDE, (end - 0.16, tail - 0.18), (end, tail), (0.28, 0.008, 0.008), LAMP)


def _repaint_roof_band(skin: Skin, d: Any, z: Any, frame: float, paint: Colour) -> None:
    band = np.concatenate([np.stack([d, z + 0.02], 1), np.stack([d, z - frame], 1)[::-1]])
    skin.polygon(Chart.SIDE, band, paint, PAINT)


def _draw_top(skin: Skin, shape: Shape, paint: Colour, rng: np.random.Generator) -> None:
    half = shape.width / 2
    seam = _dim(paint, _SEAM)

    def pane(near: tuple[float, float], far: tuple[float, float], gap: float) -> None:
        edge = [cabin_edge(shape, half, z) - 0.05 for _, z in (near, far)]
        d0, d1 = near[0] + gap * (far[0] - near[0]), far[0] - 0.06 * (far[0] - near[0])
        y0, y1 = edge[0] - 0.02, edge[1] - 0.04
        bow = 0.05 * np.sign(d0 - d1)
        rim = [(d0 + bow, 0), (d0, y0), (d1, y1), (d1 + bow, 0), (d1, -y1), (d0, -y0)]
        smooth = _rounded(rim, 0.07)
        skin.polygon(Chart.TOP, smooth, _BLACK, MATTE)
        middle = np.mean(rim, axis=0)
        skin.polygon(Chart.TOP, middle + 0.96 * (smooth - middle), _GLASS, GLASS)

    pane(shape.cowl, shape.roof_front, 0.04)
    _interior(skin, Chart.TOP, (shape.cowl[0] + 0.08, shape.roof_front[0] - 0.08), 0.62 * half, rng)
    if shape.kind not in ("van", "bus") and shape.cargo is None:
        pane(shape.rear_window, shape.roof_rear, 0.12)
    if shape.cowl[0] > 0.6:
        y = 0.66 * half
        skin.line(Chart.TOP, [(0.2, y), (shape.cowl[0] - 0.05, y + 0.08)], seam, PAINT)
        skin.line(Chart.TOP, [(0.2, -y), (shape.cowl[0] - 0.05, -y - 0.08)], seam, PAINT)
        skin.rectangle(
            Chart.TOP, (shape.cowl[0] - 0.06, -0.8 * half), (shape.cowl[0] + 0.02, 0.8 * half), _BLACK, MATTE
        )
    roof = (shape.roof_front[0] + 0.12, shape.roof_rear[0] - 0.1)
    edge = cabin_edge(shape, half, shape.height) - 0.12
    style = rng.random()
    if shape.kind in ("estate", "suv", "minivan") and style < 0.7:
        rail = (_BLACK, MATTE) if rng.random() < 0.5 else ((0.5, 0.5, 0.5), CHROME)
        for y in (edge, -edge):
            skin.line(Chart.TOP, [(roof[0] + 0.2, y), (roof[1], y)], *rail, width=0.045)
    elif style < 0.25 and shape.kind not in ("van", "bus") and shape.cargo is None:
        skin.rectangle(Chart.TOP, (roof[0], -edge + 0.15), (roof[0] + 0.75, edge - 0.15), _GLASS, GLASS)
    if shape.kind == "bus":
        for d in (2.5, 6.0, 9.0):
            skin.rectangle(Chart.TOP, (d, -0.6), (d + 1.6, 0.6), _dim(paint, 0.7), MATTE)
    if shape.bed is not None:
        low = (shape.bed[0], -0.78 * half)
        skin.rectangle(Chart.TOP, low, (shape.length - 0.12, 0.78 * half), (0.02, 0.02, 0.02), MATTE)


def _interior(skin: Skin, chart: Chart, span: tuple[float, float], half: float, rng: np.random.Generator) -> None:
    """What shows through the windscreen: dashboard, seats, who sits in them. `span`: d on top, z in front."""
    low, high = span
    if high - low < 0.25:
        return

    def oval(y: float, along: float, wide: float, long: float, colour: Colour) -> None:
        angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
        y_ring, ring = y + wide * np.cos(angle), along + long * np.sin(angle)
        points = np.stack([ring, y_ring] if chart is Chart.TOP else [y_ring, ring], axis=1)
        skin.polygon(chart, points, colour, GLASS)

    tone = rng.uniform(0.015, 0.05)
    dash = low + 0.22 * (high - low)
    corners = [(low, -half), (dash, -half * 0.95), (dash, half * 0.95), (low, half)]
    if chart is not Chart.TOP:
        corners = [(y, along) for along, y in corners]
    skin.polygon(chart, corners, (tone, tone, tone * 1.05), GLASS)
    for side in (-0.5, 0.5):
        seat = rng.uniform(0.012, 0.035)
        oval(side * half, high - 0.15 * (high - low), 0.22, 0.10 * (high - low), (seat, seat, seat))
        if side < 0 or rng.random() < 0.4:
            r, g, b = (rng.uniform(0.008, 0.04) * rng.normal(1, 0.15, 3).clip(0.6, 1.4)).tolist()
            oval(side * half, low + 0.55 * (high - low), 0.20, 0.16 * (high - low), (r, g, b))
            oval(side * half, low + 0.78 * (high - low), 0.085, 0.09 * (high - low), (0.045, 0.03, 0.024))


def _draw_front(skin: Skin, shape: Shape, paint: Colour, rng: np.random.Generator, lamps: bool) -> None:
    half, nose = shape.width / 2, shape.nose
    narrow = half * (1 - shape.corner)
    skin.rectangle(Chart.FRONT, (-half, 0), (half, shape.clearance + 0.12), _TRIM, MATTE)
    glass_half = cabin_edge(shape, half, shape.cowl[1]) - 0.06
    top_half = cabin_edge(shape, half, shape.roof_front[1]) - 0.08
    pane = [
        (-glass_half, shape.cowl[1]), (glass_half, shape.cowl[1]),
        (top_half, shape.roof_front[1] - 0.03), (-top_half, shape.roof_front[1] - 0.03),
    ]  # fmt: skip
    smooth, middle = _rounded(pane, 0.07), np.mean(pane, axis=0)
    skin.polygon(Chart.FRONT, smooth, _BLACK, MATTE)
    skin.polygon(Chart.FRONT, middle + 0.96 * (smooth - middle), _GLASS, GLASS)
    _interior(skin, Chart.FRONT, (shape.cowl[1] + 0.05, shape.roof_front[1] - 0.15), 0.62 * half, rng)
    grille = (_BLACK, MATTE)
    wide = rng.uniform(0.42, 0.60) * narrow
    z0, z1 = nose - rng.uniform(0.22, 0.34), nose - 0.07
    skin.rectangle(Chart.FRONT, (-wide, z0), (wide, z1), *grille)
    if rng.random() < 0.6:
        skin.rectangle(Chart.FRONT, (-wide, z1 - 0.02), (wide, z1 + 0.01), (0.5, 0.5, 0.5), CHROME)
    skin.circle(Chart.FRONT, (0, (z0 + z1) / 2), 0.05, (0.6, 0.6, 0.6), CHROME)
    intake = shape.clearance + 0.10
    deep = rng.uniform(0.09, 0.16)
    skin.rectangle(Chart.FRONT, (-0.66 * narrow, intake), (0.66 * narrow, intake + deep), *grille)
    lit = (LIT if lamps else LAMP)  # fmt: skip
    glow: Colour = (1.0, 0.97, 0.85) if lamps else (0.62, 0.62, 0.62)
    for side in (-1, 1):
        lamp = [
            (side * 1.04 * narrow, nose - 0.02), (side * 0.62 * narrow, nose - 0.08),
            (side * 0.64 * narrow, nose - 0.21), (side * 1.04 * narrow, nose - 0.21),
        ]  # fmt: skip
        skin.polygon(Chart.FRONT, _rounded(lamp), (0.20, 0.20, 0.21), LAMP)
        skin.circle(Chart.FRONT, (side * 0.80 * narrow, nose - 0.135), 0.066, glow, lit)
        skin.circle(Chart.FRONT, (side * 0.80 * narrow, intake + 0.06), 0.05, (0.3, 0.3, 0.3), LAMP)
    _plate(skin, Chart.FRONT, (0, intake + 0.14), rng)


def _draw_rear(skin: Skin, shape: Shape, paint: Colour, rng: np.random.Generator, lamps: bool) -> None:
    half, seam = shape.width / 2, _dim(paint, _SEAM)
    narrow = half * (1 - 0.6 * shape.corner)
    skin.rectangle(Chart.REAR, (-half, 0), (half, shape.clearance + 0.16), _TRIM, MATTE)
    if shape.kind not in ("van",) and shape.cargo is None:
        low, high = shape.rear_window, shape.roof_rear
        y0, y1 = cabin_edge(shape, half, low[1]) - 0.10, cabin_edge(shape, half, high[1]) - 0.12
        pane = [(-y0, low[1] + 0.03), (y0, low[1] + 0.03), (y1, high[1] - 0.05), (-y1, high[1] - 0.05)]
        smooth, middle = _rounded(pane, 0.07), np.mean(pane, axis=0)
        skin.polygon(Chart.REAR, smooth, _BLACK, MATTE)
        skin.polygon(Chart.REAR, middle + 0.96 * (smooth - middle), _GLASS, GLASS)
    if shape.kind == "van":
        skin.line(Chart.REAR, [(0, shape.height), (0, 0.4)], seam, PAINT)
        for side in (-1, 1):
            corners = (side * 0.10, 1.35), (side * 0.72, 1.95)
            skin.rectangle(Chart.REAR, *corners, _GLASS, GLASS)
    lamp_top, tall = shape.tail - 0.05, rng.uniform(0.12, 0.24)
    inner = rng.uniform(0.60, 0.74)
    brake: Colour = (0.75, 0.03, 0.02) if lamps else (0.30, 0.006, 0.006)
    for side in (-1, 1):
        corners = (side * inner * narrow, lamp_top - tall), (side * 1.05 * narrow, lamp_top)
        skin.rectangle(Chart.REAR, *corners, brake, LIT if lamps else LAMP)
        skin.rectangle(
            Chart.REAR, (side * inner * narrow, lamp_top - tall), (side * 0.85 * narrow, lamp_top - tall + 0.05),
            (0.5, 0.45, 0.4), LAMP,
        )  # fmt: skip
    skin.line(
        Chart.REAR, [(-0.9 * narrow, lamp_top - tall - 0.07), (0.9 * narrow, lamp_top - tall - 0.07)], seam, PAINT
    )
    _plate(skin, Chart.REAR, (0, lamp_top - tall - 0.02 if rng.random() < 0.6 else shape.clearance + 0.22), rng)


def _plate(skin: Skin, chart: Chart, centre: tuple[float, float], rng: np.random.Generator) -> None:
    y, z = centre
    skin.rectangle(chart, (y - 0.27, z - 0.065), (y + 0.27, z + 0.065), _BLACK, MATTE)
    skin.rectangle(chart, (y - 0.26, z - 0.055), (y + 0.26, z + 0.055), (0.58, 0.58, 0.56), PLATE)
    skin.rectangle(chart, (y - 0.26, z - 0.055), (y - 0.225, z + 0.055), (0.01, 0.03, 0.30), PLATE)
    for k in range(7):
        if k != 3:
            left = y - 0.19 + 0.062 * k
            skin.rectangle(chart, (left, z - 0.035), (left + 0.026 * rng.uniform(0.5, 1), z + 0.035), _BLACK, PLATE)


def _draw_wheels(skin: Skin, shape: Shape, rng: np.random.Generator) -> None:
    skin.fill(Chart.WHEEL, (0.012, 0.012, 0.012), MATTE)
    bright = rng.choice([0.10, 0.28, 0.40], p=[0.2, 0.5, 0.3])
    rim: Colour = (bright, bright, bright * 1.03)
    spokes = int(rng.integers(5, 9))
    for axle in shape.axles:
        skin.circle(Chart.WHEEL, (axle, shape.wheel), 0.68 * shape.wheel, (0.015, 0.015, 0.015), MATTE)
        for k in range(spokes):
            angle = 2 * np.pi * k / spokes + axle
            across = np.array([-np.sin(angle), np.cos(angle)]) * 0.16 * shape.wheel
            tip = np.array([axle, shape.wheel]) + 0.66 * shape.wheel * np.array([np.cos(angle), np.sin(angle)])
            hub = np.array([axle, shape.wheel])
            skin.polygon(Chart.WHEEL, [hub - across, hub + across, tip + 0.7 * across, tip - 0.7 * across], rim, CHROME)
        skin.circle(Chart.WHEEL, (axle, shape.wheel), 0.15 * shape.wheel, rim, CHROME)


def _draw_cargo(skin: Skin, shape: Shape, colour: Colour, rng: np.random.Generator, lamps: bool) -> None:
    assert shape.cargo is not None
    start, low, high = shape.cargo
    half, length = shape.width / 2, shape.length
    seam = _dim(colour, 0.6)
    skin.rectangle(Chart.SIDE, (start - 0.05, low - 0.05), (length + 0.1, high + 0.1), colour, PAINT)
    skin.rectangle(Chart.TOP, (start - 0.05, -half - 0.3), (length + 0.1, half + 0.3), colour, PAINT)
    skin.rectangle(Chart.REAR, (-half - 0.2, low - 0.05), (half + 0.2, high + 0.1), colour, PAINT)
    skin.rectangle(Chart.FRONT, (-half - 0.2, shape.roof_rear[1] + 0.1), (half + 0.2, high + 0.1), colour, PAINT)
    if rng.random() < 0.6:
        r, g, b = rng.uniform(0.01, 0.5, 3).tolist()
        ink: Colour = (r, g, b)
        left = start + rng.uniform(0.1, 0.4) * (length - start)
        band = (left, low + 0.45 * (high - low)), (left + 0.4 * (length - start), low + 0.7 * (high - low))
        skin.rectangle(Chart.SIDE, *band, ink, PAINT)
        skin.rectangle(Chart.REAR, (-0.7, low + 1.3), (0.7, low + 1.8), ink, PAINT)
    skin.line(Chart.REAR, [(0, low), (0, high)], seam, PAINT, 0.02)
    for edge in (low + 0.04, high - 0.04):
        skin.line(Chart.SIDE, [(start, edge), (length, edge)], (0.3, 0.3, 0.3), MATTE, 0.06)
        skin.line(Chart.REAR, [(-half, edge), (half, edge)], (0.3, 0.3, 0.3), MATTE, 0.06)
    brake: Colour = (0.75, 0.03, 0.02) if lamps else (0.30, 0.006, 0.006)
    for side in (-1, 1):
        skin.rectangle(Chart.REAR, (side * 0.75, 0.48), (side * 1.12, 0.60), brake, LIT if lamps else LAMP)
    _plate(skin, Chart.REAR, (0, 0.55), rng)
