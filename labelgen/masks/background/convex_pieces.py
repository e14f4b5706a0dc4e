"""Cut a shape into convex pieces: silhouettes of vehicles are nearly convex, two of them together are not."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.morphology import Mask, morph

__all__ = ["CUTS", "CutThresholds", "convex_pieces"]

Contour = NDArray[np.int32]


@dataclass(frozen=True)
class CutThresholds:
    """Thresholds of cutting a shape in two. Areas are relative to the named shape.

    Args:
        convexity: a shape is cut only if it fills at most this share of its convex hull. A larger share cuts single
            vehicles with mirrors or open doors.
        region_gain: least share of the hull's area that the cut of a changed region saves: the two pieces' hulls
            together are smaller than the whole hull by it. A smaller one cuts single vehicles.
        vehicle_gain: the same for the pixels that no shadow explains, which have gaps of their own.
        min_half_share: least area of either piece, so that no mere corner is cut off.
        min_depth_px: least depth of the concavity at which a cut starts, px.
        opening_share: diameter of the opening before the cut, as a share of the square root of the area.
        min_contour_share: contours smaller than this share of the smallest piece are dropped.
    """

    convexity: float = 0.87
    region_gain: float = 0.10
    vehicle_gain: float = 0.18
    min_half_share: float = 0.15
    min_depth_px: float = 2
    opening_share: float = 0.06
    min_contour_share: float = 0.5


CUTS = CutThresholds()


def convex_pieces(part: Mask, min_area: float, gain: float, thresholds: CutThresholds = CUTS) -> list[Mask]:
    """Cut a shape repeatedly, as long as the cut saves enough of the convex hull's area.

    Args:
        part: (h, w) the shape.
        min_area: area of the smallest vehicle, px; a shape of less than two is not cut.
        gain: `region_gain` or `vehicle_gain` of the thresholds.
        thresholds: of this stage.

    Returns:
        (h, w) masks of the pieces; the shape itself where no cut is worth it.
    """
    opening_px = max(3, thresholds.opening_share * np.sqrt(cv2.countNonZero(part)))
    opened = morph(part, cv2.MORPH_OPEN, opening_px)
    contours, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    min_contour_area = thresholds.min_contour_share * min_area
    pending = [np.asarray(c, dtype=np.int32) for c in contours if cv2.contourArea(c) >= min_contour_area]
    uncut = []
    while pending:
        contour = pending.pop()
        halves = _cut(contour, min_area, gain, thresholds)
        if halves is None:
            uncut.append(contour)
        else:
            pending.extend(halves)
    pieces = []
    for contour in uncut:
        piece = np.zeros_like(part)
        cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED)
        pieces.append(piece)
    return pieces


def _cut(contour: Contour, min_area: float, gain: float, thresholds: CutThresholds) -> tuple[Contour, Contour] | None:
    """Return the halves (K, 1, 2) along the cut with the smallest hulls; None if no cut saves enough."""
    area = cv2.contourArea(contour)
    hull_area = cv2.contourArea(cv2.convexHull(contour))
    if area < 2 * min_area or area > thresholds.convexity * hull_area:
        return None
    corners = cv2.convexHull(contour, returnPoints=False)
    try:
        defects = cv2.convexityDefects(contour, np.sort(corners.reshape(-1, 1), axis=0)[::-1])
    except cv2.error:  # OpenCV refuses hulls of contours that touch themselves
        return None
    if defects is None:
        return None
    defects = defects.reshape(-1, 4)  # (N, 1, 4) before OpenCV 5; the last column is the depth in 1/256 px
    deepest = defects[np.argsort(-defects[:, 3], kind="stable")][:2]
    best, best_sum = None, (1 - gain) * hull_area
    min_half_area = thresholds.min_half_share * area
    for start in (int(d[2]) for d in deepest if d[3] / 256 > thresholds.min_depth_px):
        better = _cut_from(np.concatenate([contour[start:], contour[: start + 1]]), min_half_area, best_sum)
        if better is not None:
            best, best_sum = better
    return best


def _cut_from(ring: Contour, min_half_area: float, limit: float) -> tuple[tuple[Contour, Contour], float] | None:
    """Find the best cut from the first point of a closed contour (K + 1, 1, 2).

    As the end of the cut moves along the contour, the first half's hull only grows and the second half's only shrinks.
    That bounds the hulls' area for all ends between two tried ones, so few ends need to be tried.

    Args:
        ring: the contour; its last point repeats the first.
        min_half_area: least area of either half, px.
        limit: the hulls' area together must be smaller than this, px.

    Returns:
        The two halves and their hulls' area together; None if no cut stays below the limit.
    """
    n = len(ring) - 1
    ends = range(n // 10, n - n // 10, max(1, n // 48))
    if not ends:
        return None
    best: int | None = None

    def try_end(i: int) -> tuple[float, float]:
        nonlocal best, limit
        halves = ring[: ends[i] + 1], ring[ends[i] :]
        one, two = (cv2.contourArea(cv2.convexHull(half)) for half in halves)
        is_better = one + two < limit or (one + two == limit and best is not None and i < best)
        if is_better and min(cv2.contourArea(half) for half in halves) >= min_half_area:
            best, limit = i, one + two
        return one, two

    spans = [(0, len(ends) - 1, try_end(0)[0], try_end(len(ends) - 1)[1])]
    while spans:
        first, last, low_one, low_two = spans.pop()
        if last - first < 2 or low_one + low_two > limit:
            continue
        middle = (first + last) // 2
        one, two = try_end(middle)
        spans += [(first, middle, low_one, two), (middle, last, one, low_two)]
    return None if best is None else ((ring[: ends[best] + 1], ring[ends[best] :]), limit)
