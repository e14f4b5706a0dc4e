"""From an image and its empty scene to the silhouettes of the vehicles in it.

The silhouette of a vehicle is what the evidence for it (`labelgen.masks.background.foreground`) spans within what has
changed, without the shade on the road under its front.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.foreground import RIM, Evidence, find_evidence
from labelgen.masks.background.model import BackgroundModel, is_ghost
from labelgen.masks.background.morphology import Mask, filled, hull, morph

__all__ = ["Silhouette", "find_silhouettes"]

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]
BoolMask = NDArray[np.bool_]

_MIN_AREA_SHARE = 0.0006
# With more than this changed it is the camera or the light, not traffic.
_UPHEAVAL = 0.7
# What is dark above a vehicle's evidence is its roof, not its shadow, up to this share of its height.
_ROOF = 0.7
# A vehicle stands where its shade is deepest, and blurred: what is less deep than this share of the deepest within so
# much above, and beside, as shares of the vehicle's size, is road. More than the last share is never taken away.
_STANDS, _STANDS_ABOVE, _STANDS_BESIDE, _STANDS_MOST = 0.8, 0.12, 0.1, 0.4
# Parts are one vehicle if this share of the hull around them has changed.
_ONE_VEHICLE = 0.9
# Longer than this for its width is no vehicle.
_LONGEST = 6.0
# Share of a changed region that evidence must span; below it vehicle and shadow look the same and both are kept.
_SPANNED = 0.35
_SOLID = 0.6
# Spurs narrower than this share of a part's size are cut off.
_SPUR = 0.12
# Half the width of the thickest part, relative to the side of the smallest vehicle: edges of lane lines are thinner.
_THICK = 0.3
_PAD = 16
# A shape is cut in two if it leaves this much of its hull free, the pieces' hulls are smaller by this share (more
# where the shape is the evidence's, which has dents of its own), and none of them is a mere corner.
_CONVEX = 0.87
_CUT_GAIN = 0.10
_CUT_GAIN_EVIDENCE = 0.18
_CUT_SHARE = 0.15


@dataclass(frozen=True)
class Silhouette:
    """One vehicle: origin px (x, y) of the crop, the crop (h, w) bool, and which share of it differs from the scene."""

    origin: tuple[int, int]
    crop: BoolMask
    score: float


def find_silhouettes(image: Image, model: BackgroundModel) -> list[Silhouette]:
    """The vehicles' silhouettes in an image (H, W, 3) uint8 BGR that lies on the model (`BackgroundModel.align`)."""
    maps = [find_evidence(part, model.shadow) for part in model.differences(image)]
    size = image.shape[0] * image.shape[1]
    if sum(cv2.countNonZero(part.changed) for part in maps) > _UPHEAVAL * size:
        return []
    return [silhouette for part in maps for silhouette in _in_part(part, image, model, _MIN_AREA_SHARE * size)]


def _in_part(part: Evidence, image: Image, model: BackgroundModel, min_area: float) -> list[Silhouette]:
    """The silhouettes in a part of an image."""
    assert model.background is not None
    joined = filled(morph(part.changed, cv2.MORPH_CLOSE, 5))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    labels, vehicle, dark, shade = (_padded(m) for m in (labels, part.vehicle, part.dark, part.shade))
    top, left = part.box[0].start, part.box[1].start
    found: list[Silhouette] = []
    for i in range(1, count):
        x, y, w, h, area = stats[i].tolist()
        if area < min_area:
            continue
        here = np.s_[y : y + h + 2 * _PAD, x : x + w + 2 * _PAD]
        region = (labels[here] == i).view(np.uint8)
        for mask in _vehicles(region, vehicle[here] & region, dark[here] & region, shade[here], min_area):
            px, py, pw, ph = cv2.boundingRect(mask)
            crop = mask[py : py + ph, px : px + pw]
            px, py = px + x - _PAD, py + y - _PAD
            origin = left + px, top + py
            if _is_ghost(crop, origin, image, model.background):
                continue
            seen = cv2.countNonZero(part.changed[py : py + ph, px : px + pw] & crop)
            found.append(Silhouette(origin, crop > 0, seen / cv2.countNonZero(crop)))
    return found


def _padded(picture: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(cv2.copyMakeBorder(picture, _PAD, _PAD, _PAD, _PAD, cv2.BORDER_CONSTANT, value=0))


def _is_ghost(crop: Mask, origin: tuple[int, int], image: Image, background: Plane) -> bool:
    (x, y), (h, w) = origin, crop.shape
    around = np.s_[max(0, y - 3) : y + h + 3, max(0, x - 3) : x + w + 3]
    whole = np.zeros(image[around].shape[:2], dtype=np.bool_)
    oy, ox = y - around[0].start, x - around[1].start
    whole[oy : oy + h, ox : ox + w] = crop
    return is_ghost(whole, image[around], background[around])


def _vehicles(region: Mask, evidence: Mask, dark: Mask, shade: Plane, min_area: float) -> list[Mask]:
    """The vehicles in one changed region (h, w), which nothing comes closer than _PAD to the sides of."""
    parts = []
    for piece in _pieces(region, min_area, _CUT_GAIN):
        for part in _spanned(piece, evidence & piece, cv2.countNonZero(region)):
            if cv2.countNonZero(part) >= 0.3 * min_area:
                parts += _pieces(part, 0.3 * min_area, _CUT_GAIN_EVIDENCE)
    out = []
    for part in _merged(parts, region):
        silhouette = _smooth(part | _roof(part, dark))
        if silhouette is not None:
            silhouette = _standing(silhouette, shade)
        if silhouette is None or cv2.countNonZero(silhouette) < min_area:
            continue
        thickness = cv2.distanceTransform(silhouette, cv2.DIST_L2, 3).max()
        if thickness >= max(_THICK * np.sqrt(min_area), np.sqrt(cv2.countNonZero(silhouette) / _LONGEST) / 2):
            out.append(silhouette)
    return out


def _spanned(piece: Mask, evidence: Mask, region_area: int) -> list[Mask]:
    """The parts of a piece that evidence spans."""
    area = cv2.countNonZero(piece)
    reach = min(max(5, 0.3 * np.sqrt(area)), 2 * _PAD - 1)
    spanned = morph(evidence, cv2.MORPH_CLOSE, reach) & piece
    spanned = morph(spanned, cv2.MORPH_OPEN, 3)
    if cv2.countNonZero(spanned) < _SPANNED * area:
        if area < 0.4 * region_area and cv2.countNonZero(evidence) < 0.1 * area:
            return []  # the shadow of the vehicle next to it
        return [piece]
    count, labels = cv2.connectedComponents(spanned)
    return [morph((labels == i).view(np.uint8), cv2.MORPH_DILATE, 2 * RIM + 1) & piece for i in range(1, count)]


def _merged(parts: list[Mask], region: Mask) -> list[Mask]:
    """Parts joined where the hull around both is nearly all changed: one vehicle with paint like the road's."""
    parts = sorted(parts, key=lambda part: -cv2.countNonZero(part))
    merged = True
    while merged:
        merged = False
        for i, j in itertools.combinations(range(len(parts)), 2):
            around = hull(parts[i] | parts[j])
            if cv2.countNonZero(around & region) >= _ONE_VEHICLE * cv2.countNonZero(around):
                parts[i] = parts[i] | parts.pop(j)
                merged = True
                break
    return parts


def _roof(part: Mask, dark: Mask) -> Mask:
    """Dark pixels right above a part: shadows lie beside and below a vehicle, so these are its roof."""
    x, y, w, h = cv2.boundingRect(part)
    margin = w // 8
    roof = np.zeros_like(part)
    above = np.s_[max(0, y - int(_ROOF * h)) : y + h // 2, x + margin : x + w - margin]
    roof[above] = dark[above]
    roof = morph(roof, cv2.MORPH_OPEN, 3) | part
    _, labels = cv2.connectedComponents(roof)
    joined: BoolMask = labels == np.bincount(labels[part > 0]).argmax()
    return joined.view(np.uint8)


def _smooth(part: Mask) -> Mask | None:
    """The part without spurs and dents, or None if it is no solid shape."""
    size = max(3, _SPUR * np.sqrt(cv2.countNonZero(part)))
    # Opening rounds corners off; what it took next to what it left is given back, which leaves spurs their roots alone.
    part = part & morph(morph(part, cv2.MORPH_OPEN, size), cv2.MORPH_DILATE, size / 2)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea)
    corners = cv2.convexHull(contour)
    if cv2.contourArea(contour) < _SOLID * cv2.contourArea(corners):
        return None
    out = np.zeros_like(part)
    cv2.drawContours(out, [corners], -1, 1, cv2.FILLED)
    return out


def _standing(part: Mask, shade: Plane) -> Mask | None:
    """The part without the shade on the road below it, which deepens towards the vehicle."""
    x, y, w, h = cv2.boundingRect(part)
    here = np.s_[y : y + h, x : x + w]
    inside, own = part[here] > 0, np.where(part[here] > 0, shade[here], 0)
    size = np.sqrt(float(cv2.countNonZero(part)))
    above, beside = max(2, int(_STANDS_ABOVE * size)), max(1, int(_STANDS_BESIDE * size))
    kernel = np.ones((above + 1, 2 * beside + 1), np.uint8)
    deepest = cv2.dilate(
        np.maximum(own, 0), kernel, anchor=(beside, above), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    road = ~inside | ((own >= 0) & (own < _STANDS * deepest))
    below = np.logical_and.accumulate(road[::-1], axis=0)[::-1]
    kept = np.zeros_like(part)
    kept[here] = inside & ~below
    return _smooth(kept) if cv2.countNonZero(kept) >= (1 - _STANDS_MOST) * cv2.countNonZero(part) else part


def _pieces(part: Mask, min_area: float, gain: float) -> list[Mask]:
    """A shape, cut where that leaves clearly more convex pieces: vehicles are convex, two of them together are not."""
    opened = morph(part, cv2.MORPH_OPEN, max(3, 0.06 * np.sqrt(cv2.countNonZero(part))))
    contours, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    todo = [np.asarray(c, dtype=np.int32) for c in contours if cv2.contourArea(c) >= 0.5 * min_area]
    done = []
    while todo:
        contour = todo.pop()
        halves = _cut(contour, min_area, gain)
        if halves is None:
            done.append(contour)
        else:
            todo.extend(halves)
    out = []
    for contour in done:
        piece = np.zeros_like(part)
        cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED)
        out.append(piece)
    return out


def _cut(
    contour: NDArray[np.int32], min_area: float, gain: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]] | None:
    """The two halves (K, 1, 2) of a contour along the cut that makes their hulls smallest, if that is worth it."""
    area = cv2.contourArea(contour)
    whole = cv2.contourArea(cv2.convexHull(contour))
    if area < 2 * min_area or area > _CONVEX * whole:
        return None
    corners = cv2.convexHull(contour, returnPoints=False)
    try:
        defects = cv2.convexityDefects(contour, np.sort(corners.reshape(-1, 1), axis=0)[::-1])
    except cv2.error:  # OpenCV refuses hulls of contours that touch themselves
        return None
    if defects is None:
        return None
    defects = defects.reshape(-1, 4)  # (N, 1, 4) before OpenCV 5
    deepest = defects[np.argsort(-defects[:, 3], kind="stable")][:2]
    best, best_sum = None, (1 - gain) * whole
    for start in (int(d[2]) for d in deepest if d[3] / 256 > 2):
        better = _cut_from(np.concatenate([contour[start:], contour[: start + 1]]), _CUT_SHARE * area, best_sum)
        if better is not None:
            best, best_sum = better
    return best


def _cut_from(
    ring: NDArray[np.int32], least_area: float, limit: float
) -> tuple[tuple[NDArray[np.int32], NDArray[np.int32]], float] | None:
    """The halves along the best cut from the first point of a closed contour (K + 1, 1, 2), and their hulls' area.

    Their hulls' area must be below the limit. As the other end of the cut moves on, the first half's hull only grows
    and the second one's only shrinks: that bounds what lies between two ends, and few need to be tried.
    """
    n = len(ring) - 1
    ends = range(n // 10, n - n // 10, max(1, n // 48))
    if not ends:
        return None
    best: int | None = None

    def tried(i: int) -> tuple[float, float]:
        nonlocal best, limit
        halves = ring[: ends[i] + 1], ring[ends[i] :]
        one, two = (cv2.contourArea(cv2.convexHull(half)) for half in halves)
        better = one + two < limit or (one + two == limit and best is not None and i < best)
        if better and min(cv2.contourArea(half) for half in halves) >= least_area:
            best, limit = i, one + two
        return one, two

    spans = [(0, len(ends) - 1, tried(0)[0], tried(len(ends) - 1)[1])]
    while spans:
        first, last, low_one, low_two = spans.pop()
        if last - first < 2 or low_one + low_two > limit:
            continue
        middle = (first + last) // 2
        one, two = tried(middle)
        spans += [(first, middle, low_one, two), (middle, last, one, low_two)]
    return None if best is None else ((ring[: ends[best] + 1], ring[ends[best] :]), limit)
