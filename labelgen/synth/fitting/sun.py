"""Where the sun stands and how deep its shadows are, from the shadows that vehicles cast in a video.

A shadow on the road is an even part of what differs from the empty road: the road's own picture, darker by the same
factor wherever vehicles drive. How dark tells how much light the sun takes with it; where the sun stands follows from
shadows of boxes of a car's size, drawn for many directions and laid over those in the video.
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

__all__ = ["NEAR_SHADOW", "Shadows", "find_shadows"]

NEAR_SHADOW = 0.13
"""By how much the share that a shadow leaves varies."""

_EVEN = 0.035
_BINS, _LEAST_SHARE = 40, 0.05
_SUNNY_BELOW = 0.66
"""Share of the road's grey levels that shadows under an overcast sky keep at least."""
_SLOPES = np.linspace(-1.75, 1.75, 15)
_MOST_CARS, _AGREEING, _LEAST_AGREEMENT = 24, 0.6, 0.30
_BLACK = 0.12
"""Share of light below which shadows cannot be told from dark vehicles."""
_SHIFTS_M = (-1.5, -0.75, 0.0, 0.75)
_LONG = 0.03
"""How much the agreement must gain for a shadow that is longer by the height of what casts it."""
# A car as two boxes: x from and to, half the width, height, metres, its near end at x = 0.
_BOXES = ((0.0, 4.4, 0.86, 0.88), (1.0, 3.8, 0.70, 1.45))

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Shadows:
    """What shadows tell.

    Args:
        left: share of the road's grey levels that a shadow keeps; None where no shadow stands out.
        sun: (3,) unit vector towards the sun in the road frame; None without the sun, or where it cannot be told.
        cars: how many vehicles the direction rests on.
    """

    left: float | None
    sun: NDArray[np.float64] | None
    cars: int

    @property
    def sunny(self) -> bool:
        """Whether the sun shines."""
        return self.left is not None and self.left < _SUNNY_BELOW


def find_shadows(footage: Footage, camera: Camera, road: Mask) -> Shadows:
    """The shadows of a video's vehicles.

    Args:
        footage: of it.
        camera: with a scale, for frames of its size.
        road: (H, W).
    """
    grey = cv2.cvtColor(footage.empty, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1
    counts, changed = np.zeros(_BINS), 0
    ratios = []
    for look in footage.looks:
        ratio = (cv2.cvtColor(look, cv2.COLOR_BGR2GRAY).astype(np.float32) + 1) / grey
        mean = cv2.blur(ratio, (3, 3))
        uneven = cv2.blur(ratio * ratio, (3, 3)) - mean * mean
        change = footage.changed(look) & road
        even = change & (uneven < _EVEN**2) & (ratio < 0.95)
        counts += np.histogram(ratio[even], _BINS, (0, 1))[0]
        changed += int(np.count_nonzero(change))
        ratios.append((np.where(even, ratio, 2).astype(np.float32), change))
    smooth = np.convolve(counts, [0.25, 0.5, 0.25], mode="same")
    peak = int(smooth.argmax())
    if smooth[max(0, peak - 2) : peak + 3].sum() < _LEAST_SHARE * max(changed, 1):
        return Shadows(None, None, 0)
    left = (peak + 0.5) / _BINS
    found = Shadows(left, None, 0)
    if not found.sunny or left < _BLACK:
        return found
    cars = [car for ratio, change in ratios for car in _cars(np.abs(ratio - left) < NEAR_SHADOW, change, camera)]
    if len(cars) < 3:
        return found
    step = max(1, len(cars) // _MOST_CARS)
    direction = _direction(cars[::step], camera)
    return Shadows(left, direction, len(cars[::step]))


@dataclass(frozen=True, eq=False)
class _Car:
    """A vehicle that differs from the road: its shadow in a window of the frame, and its near end on the road."""

    shadow: Mask
    origin: tuple[int, int]
    near_xy: NDArray[np.float64]


def _cars(shadow: Mask, change: Mask, camera: Camera) -> Iterator[_Car]:
    """The changes that look like single cars with a shadow."""
    height, width = change.shape
    count, labels, stats, _ = cv2.connectedComponentsWithStats(change.astype(np.uint8))
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
        spot = np.array([x + np.median(columns[foot]) + 0.5, y + np.percentile(rows, 98) + 1.0])
        near = camera.road_points(spot[None], invalid="nan")[0]
        wide = camera.road_points(
            np.array([[x + columns.min(), spot[1]], [x + columns.max() + 1, spot[1]]]), invalid="nan"
        )
        if np.isfinite(near).all() and np.isfinite(wide).all() and 1.2 < abs(wide[0, 1] - wide[1, 1]) < 3.2:
            yield _Car(dark, (x, y), near)


def _direction(cars: list[_Car], camera: Camera) -> NDArray[np.float64] | None:
    """The direction whose shadows cover those of the video best; None where none covers them well."""
    every = np.zeros((len(cars), len(_SLOPES), len(_SLOPES)))
    for k, car in enumerate(cars):
        for i, along in enumerate(_SLOPES):
            for j, aside in enumerate(_SLOPES):
                every[k, i, j] = max(_agreement(car, camera, shift, along, aside) for shift in _SHIFTS_M)
    # Dark cars pass for shadows themselves; those that agree with no direction tell nothing.
    best = every.max(axis=(1, 2))
    telling = best >= np.quantile(best, _AGREEING)
    long = np.hypot(_SLOPES[:, None], _SLOPES)
    scores = cv2.GaussianBlur(every[telling].mean(axis=0), (0, 0), 0.7) - _LONG * long
    row, column = divmod(int(scores.argmax()), len(_SLOPES))
    if scores[row, column] < _LEAST_AGREEMENT:
        return None
    sun = np.array([-_SLOPES[row], -_SLOPES[column], 1.0])
    return np.asarray(sun / np.linalg.norm(sun))


def _agreement(car: _Car, camera: Camera, shift: float, along: float, aside: float) -> float:
    """Intersection over union of a car's shadow with that of two boxes; `along`, `aside`: shadow per height."""
    height, width = car.shadow.shape
    cast, body = (np.zeros((height, width), dtype=np.uint8) for _ in range(2))
    for x0, x1, half, top in _BOXES:
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
