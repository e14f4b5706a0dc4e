"""Direction of the sun and depth of its shadows, estimated from the shadows of vehicles in a video.

A shadow on the road is an even part of the foreground: the background image, darker by one factor wherever vehicles
drive. The factor tells how much of the light comes from the sun. The direction follows from shadows of boxes of a
car's size, which are projected for many directions and compared with those in the video.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import Camera
from labelgen.synth.fitting.footage import Footage

__all__ = ["SUN", "Shadows", "SunThresholds", "find_shadows"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SunThresholds:
    """Thresholds for finding shadows and the sun.

    Args:
        shadow_spread: by how much the brightness that a shadow leaves varies, as a share of the road's. A wider range
            takes dark paint for shadow.
        even_std: standard deviation of that share in 3 x 3 px, below which a pixel may be shadow.
        histogram_bins: bins of the share's histogram between 0 and 1.
        peak_share: share of the foreground that the histogram's peak must hold for shadows to count as found.
        sunny_below: share of the road's grey levels above which shadows are those of an overcast sky.
        too_dark: share below which shadows cannot be told from dark vehicles, so that no direction is estimated.
        max_slope, slopes: greatest length of a shadow per height, and the number of steps of the search along and
            across the road.
        max_cars: vehicles that the search uses; its time grows with them.
        agreeing_quantile: quantile of the cars' best agreement below which a car does not vote.
        min_agreement: intersection over union below which no direction is returned.
        shifts_m: positions of the car along the road, relative to where its near end appears, that are tried.
        length_penalty: intersection over union that a shadow must gain per unit of its length per height.
        boxes_m: a car as boxes (x from, x to, half width, height), metres; its near end lies at x = 0.
    """

    shadow_spread: float = 0.13
    even_std: float = 0.035
    histogram_bins: int = 40
    peak_share: float = 0.05
    sunny_below: float = 0.66
    too_dark: float = 0.12
    max_slope: float = 1.75
    slopes: int = 15
    max_cars: int = 24
    agreeing_quantile: float = 0.6
    min_agreement: float = 0.30
    shifts_m: tuple[float, ...] = (-1.5, -0.75, 0.0, 0.75)
    length_penalty: float = 0.03
    boxes_m: tuple[tuple[float, float, float, float], ...] = ((0.0, 4.4, 0.86, 0.88), (1.0, 3.8, 0.70, 1.45))


SUN = SunThresholds()


@dataclass(frozen=True, eq=False)
class Shadows:
    """Shadows of a video's vehicles.

    Args:
        left: share of the road's grey levels that a shadow leaves; None where no shadow stands out.
        sun: (3,) unit vector towards the sun in the road frame; None without the sun, or where it is not known.
        cars: number of vehicles from which the direction is estimated.
        sunny_below: see `SunThresholds`.
    """

    left: float | None
    sun: NDArray[np.float64] | None
    cars: int
    sunny_below: float = SUN.sunny_below

    @property
    def sunny(self) -> bool:
        """Whether the sun shines."""
        return self.left is not None and self.left < self.sunny_below


def find_shadows(footage: Footage, camera: Camera, road: Mask, thresholds: SunThresholds = SUN) -> Shadows:
    """Estimate how dark the shadows of a video's vehicles are, and where the sun stands.

    Args:
        footage: of the video.
        camera: with a scale, for frames of its size.
        road: (H, W) road mask.
        thresholds: of this stage.
    """
    grey = cv2.cvtColor(footage.background, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1
    counts, changed = np.zeros(thresholds.histogram_bins), 0
    ratios = []
    for frame in footage.frames:
        ratio = (cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1) / grey
        mean = cv2.blur(ratio, (3, 3))
        variance = cv2.blur(ratio * ratio, (3, 3)) - mean * mean
        foreground = footage.foreground(frame) & road
        even = foreground & (variance < thresholds.even_std**2) & (ratio < 0.95)
        counts += np.histogram(ratio[even], thresholds.histogram_bins, (0, 1))[0]
        changed += int(np.count_nonzero(foreground))
        ratios.append((np.where(even, ratio, 2).astype(np.float32), foreground))
    smooth = np.convolve(counts, [0.25, 0.5, 0.25], mode="same")
    peak = int(smooth.argmax())
    if smooth[max(0, peak - 2) : peak + 3].sum() < thresholds.peak_share * max(changed, 1):
        return Shadows(None, None, 0, thresholds.sunny_below)
    left = (peak + 0.5) / thresholds.histogram_bins
    without_direction = Shadows(left, None, 0, thresholds.sunny_below)
    if not without_direction.sunny or left < thresholds.too_dark:
        return without_direction
    spread = thresholds.shadow_spread
    cars = [car for ratio, foreground in ratios for car in _cars(np.abs(ratio - left) < spread, foreground, camera)]
    if len(cars) < 3:
        return without_direction
    step = max(1, len(cars) // thresholds.max_cars)
    direction = _direction(cars[::step], camera, thresholds)
    return Shadows(left, direction, len(cars[::step]), thresholds.sunny_below)


@dataclass(frozen=True, eq=False)
class _Car:
    """A vehicle in the foreground: its shadow in a window of the frame, and its near end on the road."""

    shadow: Mask
    origin: tuple[int, int]
    near_xy: NDArray[np.float64]


def _cars(shadow: Mask, foreground: Mask, camera: Camera) -> Iterator[_Car]:
    """Yield the foreground's components that look like single cars with a shadow."""
    height, width = foreground.shape
    count, labels, stats, _ = cv2.connectedComponentsWithStats(foreground.astype(np.uint8))
    for k in range(1, count):
        x, y, w, h, area = (int(v) for v in stats[k])
        if area < 150 or x <= 1 or y <= 1 or x + w >= width - 1 or y + h >= height - 1:
            continue
        whole = labels[y : y + h, x : x + w] == k
        dark = whole & (cv2.morphologyEx(
            shadow[y : y + h, x : x + w].astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        )  # fmt: skip
        dark = whole & (cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0)
        body = cv2.morphologyEx((whole & ~dark).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        if not 0.12 < np.count_nonzero(dark) / area < 0.75 or np.count_nonzero(body) < 60:
            continue
        rows, columns = np.nonzero(body)
        foot = rows >= np.percentile(rows, 90)
        contact = np.array([x + np.median(columns[foot]) + 0.5, y + np.percentile(rows, 98) + 1.0])
        near = camera.road_points(contact[None], invalid="nan")[0]
        wide = camera.road_points(
            np.array([[x + columns.min(), contact[1]], [x + columns.max() + 1, contact[1]]]), invalid="nan"
        )
        if np.isfinite(near).all() and np.isfinite(wide).all() and 1.2 < abs(wide[0, 1] - wide[1, 1]) < 3.2:
            yield _Car(dark, (x, y), near)


def _direction(cars: list[_Car], camera: Camera, thresholds: SunThresholds) -> NDArray[np.float64] | None:
    """Return the direction whose projected shadows agree best with those of the video; None where none agrees well."""
    slopes = np.linspace(-thresholds.max_slope, thresholds.max_slope, thresholds.slopes)
    every = np.zeros((len(cars), len(slopes), len(slopes)))
    for k, car in enumerate(cars):
        for i, along in enumerate(slopes):
            for j, aside in enumerate(slopes):
                every[k, i, j] = max(
                    _agreement(car, camera, shift, along, aside, thresholds.boxes_m) for shift in thresholds.shifts_m
                )
    # Dark cars are taken for shadows; those that agree with no direction do not vote.
    best = every.max(axis=(1, 2))
    voting = best >= np.quantile(best, thresholds.agreeing_quantile)
    length = np.hypot(slopes[:, None], slopes)
    scores = cv2.GaussianBlur(every[voting].mean(axis=0), (0, 0), 0.7) - thresholds.length_penalty * length
    row, column = divmod(int(scores.argmax()), len(slopes))
    if scores[row, column] < thresholds.min_agreement:
        return None
    sun = np.array([-slopes[row], -slopes[column], 1.0])
    return np.asarray(sun / np.linalg.norm(sun))


def _agreement(
    car: _Car, camera: Camera, shift: float, along: float, aside: float,
    boxes_m: tuple[tuple[float, float, float, float], ...],
) -> float:  # fmt: skip
    """Return the intersection over union of a car's shadow with that of boxes; `along`, `aside`: shadow per height."""
    height, width = car.shadow.shape
    cast, body = (np.zeros((height, width), dtype=np.uint8) for _ in range(2))
    for x0, x1, half, top in boxes_m:
        corners = np.array([[x, y, z] for x in (x0, x1) for y in (-half, half) for z in (0.1, top)])
        corners[:, :2] += [car.near_xy[0] + shift, car.near_xy[1]]
        foot = corners[:, :2] - corners[:, 2:] * [-along, -aside]
        _fill(cast, camera.project(foot), car.origin)
        _fill(body, camera.project(corners), car.origin)
    visible = (cast > 0) & (body == 0)
    union = int(np.count_nonzero(visible | car.shadow))
    return int(np.count_nonzero(visible & car.shadow)) / max(union, 1)


def _fill(into: NDArray[np.uint8], points_px: Any, origin: tuple[int, int]) -> None:
    if np.isfinite(points_px).all():
        corners = np.round(points_px - np.array(origin) - 0.5).astype(np.int32)
        cv2.fillConvexPoly(into, cv2.convexHull(corners), 1)
