"""Texture of a vehicle: one image that holds several orthographic drawings of it, one for each `Chart`.

Channels: linear RGB as square roots in 8 bit, the material (see `shading.materials`), and two slopes of the surface
along the drawing's columns and rows, 128 for level, in steps of 0.01 m per m: creases, gaps and bulges.

Convention: points of a drawing are (d, z) on the sides, (d, y) on top and (y, z) at the ends, in metres; d counts from
the front backwards, z from the road upwards, and y at the ends points to the viewer's right.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.shading.materials import MATTE, PAINT
from labelgen.synth.vehicle.mesh import Chart

__all__ = ["Colour", "Texture", "dim", "rounded"]

_PPM, _PPM_LONG = 96, 56
"""Texels per metre, of cars and of vehicles longer than `_LONG_M`."""
_LONG_M = 6.5
# Width of the blur in texels. Cameras see these drawings foreshortened; a texel seen squarely fills at most a pixel.
_FORESHORTENED = ((Chart.SIDE, 5), (Chart.TOP, 5))
_FONT, _CAPITAL_PX = cv2.FONT_HERSHEY_DUPLEX, 21.0
"""Font of letters, and the height of its capitals at scale 1."""
_FINE_PX, _SOFT_PX, _SOFT_SHADOW_PX = 1.2, 6.0, 5
"""Sigma of the blur of sharp and of soft relief, and width of that of shadows, texels."""

Colour = tuple[float, float, float]
"""Linear RGB, 0 to 1."""


class Texture:
    """An image that is painted chart by chart, and its mip levels.

    Args:
        extent_lwh: metres, length, width and height of the mesh's bounding cuboid.

    Attributes:
        ppm: texels per metre.
        maps: (len(Chart), 2, 4) float64, from the vehicle's frame (x, y, z, 1) to texture px.
    """

    def __init__(self, extent_lwh: Sequence[float]) -> None:
        length, width, height = extent_lwh
        self.ppm = _PPM if length < _LONG_M else _PPM_LONG
        wide = int(np.ceil(max(length, width) * self.ppm)) + 2
        rows = [height, width, height, height, height, 0.1, 0.1]
        tops = np.cumsum([0] + [int(np.ceil(r * self.ppm)) + 2 for r in rows])
        self._colours = np.zeros((tops[-1], wide, 4), dtype=np.uint8)
        self._relief = [np.zeros((tops[-1], wide), dtype=np.float32) for _ in range(2)]
        self._bows = np.zeros((2, tops[-1], wide), dtype=np.float32)
        self._dark = np.zeros((tops[-1], wide), dtype=np.uint8)
        self.maps = np.zeros((len(Chart), 2, 4))
        self._tops, self._height, self._width = tops, height, width
        self._levels: list[tuple[NDArray[np.uint8], NDArray[np.float64]]] = []
        for chart in (Chart.SIDE, Chart.WHEEL):
            self.maps[chart] = [[-1, 0, 0, length / 2], [0, 0, -1, height]]
        self.maps[Chart.TOP] = [[-1, 0, 0, length / 2], [0, -1, 0, width / 2]]
        self.maps[Chart.FRONT] = [[0, 1, 0, width / 2], [0, 0, -1, height]]
        self.maps[Chart.REAR] = [[0, -1, 0, width / 2], [0, 0, -1, height]]
        self.maps *= self.ppm
        self.maps[:, 1, 3] += tops[:-1]

    def _pixels(self, chart: Chart, points: Any) -> NDArray[np.int32]:
        p = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if chart is Chart.TOP:
            u, v = p[:, 0], self._width / 2 - p[:, 1]
        elif chart in (Chart.FRONT, Chart.REAR):
            u, v = p[:, 0] + self._width / 2, self._height - p[:, 1]
        else:
            u, v = p[:, 0], self._height - p[:, 1]
        pixels = np.stack([u * self.ppm, v * self.ppm], axis=1)
        return np.round(pixels * 16 - 8).astype(np.int32)

    def _rows(self, chart: Chart) -> slice:
        return slice(int(self._tops[chart]), int(self._tops[chart + 1]))

    def fill(self, chart: Chart, colour: Colour, material: int) -> None:
        """Paint a whole chart."""
        self._colours[self._rows(chart)] = _texel(colour, material)

    def polygon(self, chart: Chart, points: Any, colour: Colour, material: int) -> None:
        """Paint a polygon; points (N, 2) in metres, see the module's convention."""
        view = self._colours[self._rows(chart)]
        cv2.fillPoly(view, [self._pixels(chart, points)], _texel(colour, material), cv2.LINE_8, 4)

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
        view = self._colours[self._rows(chart)]
        thick = max(1, round(width * self.ppm))
        cv2.polylines(view, [self._pixels(chart, points)], False, _texel(colour, material), thick, cv2.LINE_8, 4)

    def text(
        self, chart: Chart, at: tuple[float, float], words: str, height: float, colour: Colour, material: int
    ) -> float:
        """Write words, and return their width in metres.

        Args:
            chart: drawing.
            at: lower left corner, as for `polygon`.
            words: ASCII.
            height: of capitals, metres.
            colour: of the letters.
            material: of the letters.
        """
        view = self._colours[self._rows(chart)]
        x, y = (self._pixels(chart, [at])[0] / 16).round().astype(int).tolist()
        scale, thick = height * self.ppm / _CAPITAL_PX, max(1, round(0.17 * height * self.ppm))
        # Through a mask, since some versions of OpenCV blend four channels, and materials must not be blended.
        letters = np.zeros(view.shape[:2], dtype=np.uint8)
        cv2.putText(letters, words, (x, y), _FONT, scale, 255, thick, cv2.LINE_8)
        view[letters > 127] = _texel(colour, material)
        return float(cv2.getTextSize(words, _FONT, scale, thick)[0][0] / self.ppm)

    def fade(self, chart: Chart, points: Any, colour: Colour, shares: Sequence[float], *, level: bool = False) -> None:
        """Blend a colour into a polygon: reflections on glass, dust on panels.

        Args:
            chart: drawing.
            points: as for `polygon`.
            colour: blended in.
            shares: 0 to 1, of that colour at the polygon's top and at its foot, interpolated linearly.
            level: from left to right rather than from top to foot.
        """
        rows = self._rows(chart)
        mask = np.zeros(self._dark[rows].shape, dtype=np.uint8)
        cv2.fillPoly(mask, [self._pixels(chart, points)], 255, cv2.LINE_8, 4)
        x, y, w, h = cv2.boundingRect(mask)
        if not w or not h:
            return
        view = self._colours[rows][y : y + h, x : x + w]
        ramp = np.linspace(shares[0], shares[1], w if level else h, dtype=np.float32)
        share = np.where(mask[y : y + h, x : x + w] > 0, ramp[None] if level else ramp[:, None], 0)[..., None]
        into = np.array(_texel(colour, 0)[:3], dtype=np.float32)
        view[..., :3] = (view[..., :3] + share * (into - view[..., :3])).round()

    def emboss(self, chart: Chart, points: Any, height: float, *, soft: bool = False) -> None:
        """Raise a polygon by a height in metres; `soft` widens its edge."""
        view = self._relief[soft][self._rows(chart)]
        cv2.fillPoly(view, [self._pixels(chart, points)], height, cv2.LINE_8, 4)

    def groove(self, chart: Chart, points: Any, depth: float = 0.008, width: float = 0.016) -> None:
        """Draw a gap between panels, or a crease when the depth in metres is negative."""
        view = self._relief[0][self._rows(chart)]
        thick = max(1, round(width * self.ppm))
        cv2.polylines(view, [self._pixels(chart, points)], False, -depth, thick, cv2.LINE_8, 4)

    def bow(self, chart: Chart, points: Any, bend: Sequence[float], lean: Sequence[float] = (0.0, 0.0)) -> None:
        """Curve a panel within a polygon by tilting its normals; the mesh does not change.

        Args:
            chart: drawing.
            points: as for `polygon`.
            bend: 1 / m, curvature along the drawing's columns and rows.
            lean: m per m, slope along them at the polygon's centre.
        """
        rows = self._rows(chart)
        ring = self._pixels(chart, points)
        mask = np.zeros(self._dark[rows].shape, dtype=np.uint8)
        cv2.fillPoly(mask, [ring], 255, cv2.LINE_8, 4)
        x, y, w, h = cv2.boundingRect(mask)
        inside = mask[y : y + h, x : x + w] > 0
        across = (np.arange(w) - w / 2) / self.ppm
        down = (np.arange(h) - h / 2) / self.ppm
        view = self._bows[:, rows][:, y : y + h, x : x + w]
        view[0] += np.where(inside, lean[0] - bend[0] * across[None], 0)
        view[1] += np.where(inside, lean[1] - bend[1] * down[:, None], 0)

    def flatten(self, chart: Chart, points: Any) -> None:
        """Undo `bow` within a polygon: number plates are flat."""
        rows = self._rows(chart)
        for plane in self._bows:
            cv2.fillPoly(plane[rows], [self._pixels(chart, points)], 0.0, cv2.LINE_8, 4)

    def shadow(self, chart: Chart, points: Any, share: float, width: float = 0.05) -> None:
        """Darken a line softly, as ambient occlusion does in hollows and at edges.

        Args:
            chart: drawing.
            points: as for `line`.
            share: 0 to 1, of the light that is lost.
            width: metres.
        """
        view = self._dark[self._rows(chart)]
        thick = max(1, round(width * self.ppm))
        cv2.polylines(view, [self._pixels(chart, points)], False, round(255 * share), thick, cv2.LINE_8, 4)

    def weather(self, chart: Chart, streaks: float, blots: float, rng: np.random.Generator) -> None:
        """Darken paint and trim unevenly, as rain, dust and age do; glass and lamps stay.

        Args:
            chart: drawing.
            streaks: share of the light that is lost in the darkest vertical streaks.
            blots: the same in wide patches.
            rng: gives their positions.
        """
        view = self._colours[self._rows(chart)]
        h, w = view.shape[:2]

        def cloud(across_m: float, down_m: float) -> NDArray[np.float32]:
            coarse = (2 + int(h / (down_m * self.ppm)), 2 + int(w / (across_m * self.ppm)))
            smooth = cv2.resize(rng.random(coarse).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
            return np.asarray(smooth.clip(0, 1))

        taken = streaks * cloud(0.12, 1.2) * cloud(0.6, 0.8) + blots * cloud(0.5, 0.4)
        dull = (view[..., 3] == PAINT) | (view[..., 3] == MATTE)
        # Colours are stored as square roots.
        factor = np.where(dull, np.sqrt(np.clip(1 - taken, 0.1, 1)), 1)[..., None]
        view[..., :3] = (view[..., :3] * factor).round()

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """(h, w, 6) uint8, the finished texture; computed at the first access, without what is painted later."""
        out = np.full((*self._colours.shape[:2], 6), 128, dtype=np.uint8)
        out[..., :4] = self._colours
        for chart in Chart:
            # Filters must not cross the border between two drawings.
            rows = self._rows(chart)
            fine, soft = (plane[rows] for plane in self._relief)
            bows = self._bows[:, rows]
            if self._dark[rows].any():
                factor = 1 - cv2.blur(self._dark[rows], (_SOFT_SHADOW_PX, _SOFT_SHADOW_PX)) / np.float32(255)
                # Colours are stored as square roots.
                out[rows, :, :3] = (out[rows, :, :3] * np.sqrt(factor)[..., None]).round()
            if not fine.any() and not soft.any() and not bows.any():
                continue
            height = cv2.GaussianBlur(fine, (0, 0), _FINE_PX) + cv2.GaussianBlur(soft, (0, 0), _SOFT_PX)
            for channel, (dx, dy) in ((4, (1, 0)), (5, (0, 1))):
                slope = cv2.Sobel(height, cv2.CV_32F, dx, dy, ksize=3, scale=self.ppm / 8)
                out[rows, :, channel] = (128 + 100 * (slope + bows[dy])).clip(0, 255).round().astype(np.uint8)
        return out

    def level(self, metres_per_px: float) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Return the mip level for pixels of this size: image (h, w, 6) uint8 and maps (len(Chart), 2, 4)."""
        if not self._levels:
            self._levels.append((self._along_the_road(self.image, 1.0), self.maps))
            image, maps = self.image, self.maps
            for number in range(4):
                size = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
                parts = [cv2.resize(image[..., k : k + 3], size, interpolation=cv2.INTER_AREA) for k in (0, 3)]
                half: Any = np.concatenate(parts, axis=2)
                # Materials are sampled, not averaged.
                half[..., 3] = image[: 2 * size[1] : 2, : 2 * size[0] : 2, 3]
                image, maps = half, maps / 2
                self._levels.append((self._along_the_road(half, 0.5 ** (number + 1)), maps))
        number = int(np.clip(np.floor(np.log2(max(metres_per_px * self.ppm, 1.0)) + 0.45), 0, 4))
        return self._levels[number]

    def _along_the_road(self, image: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
        """Return a level blurred along the vehicle on sides and top, which traffic cameras see foreshortened."""
        out = image.copy()
        for chart, texels in _FORESHORTENED:
            first, last = (round(scale * int(self._tops[chart + k])) for k in (0, 1))
            if last - first > 1:
                rows = slice(first, last)
                for part in (slice(0, 3), slice(4, 6)):  # all channels but the material
                    out[rows, :, part] = cv2.blur(np.ascontiguousarray(image[rows, :, part]), (texels, 1))
        return out


def _texel(colour: Colour, material: int) -> tuple[int, int, int, int]:
    r, g, b = (round(255 * float(np.sqrt(min(max(c, 0), 1)))) for c in colour)
    return r, g, b, material


def rounded(points: Any, share: float = 0.12) -> NDArray[np.float64]:
    """Return a closed polygon (4 N, 2) with its corners cut twice (Chaikin), as glass and lamps have them."""
    ring = np.asarray(points, dtype=np.float64)
    for cut in (share, 0.25):
        ahead = np.roll(ring, -1, axis=0) - ring
        ring = np.stack([ring + cut * ahead, ring + (1 - cut) * ahead], axis=1).reshape(-1, 2)
    return ring


def dim(colour: Colour, factor: float) -> Colour:
    """Return a colour times a factor."""
    return colour[0] * factor, colour[1] * factor, colour[2] * factor
