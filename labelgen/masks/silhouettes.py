"""From an image and its empty scene to the silhouettes of the vehicles in it.

A change can be vehicle or cast shadow. A shadow darkens without changing colour and without adding texture, so what is
brighter, coloured, darker than the scene's shadows, or textured *inside* a changed region is evidence for a vehicle;
the silhouette is what the evidence spans within the change. An outline alone is no evidence: shadows have one too.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background_model import BackgroundModel, is_ghost, lightness, strongest

__all__ = ["Silhouette", "evidence_maps", "find_silhouettes"]

Image = NDArray[np.uint8]
Mask = NDArray[np.uint8]
BoolMask = NDArray[np.bool_]

_MIN_AREA_SHARE = 0.0006
# With more than this changed it is the camera or the light, not traffic.
_UPHEAVAL = 0.7
# Blurred borders are cut where the difference falls below this share of what it is 2 px further inside.
_BORDER_SHARE = 0.35
_RIM = 2
_LEVEL_SHARE = 0.85
_BLACK = (0.38, 0.7)
_COLOUR_LEVELS = 14.0
_TEXTURE_LEVELS = 22
# What is at least this dark above a vehicle's evidence is its roof, not its shadow, up to this share of its height.
_DARK = 0.6
_ROOF = 0.7
# Parts are one vehicle if this share of the hull around them has changed.
_ONE_VEHICLE = 0.9
# Longer than this for its width is no vehicle.
_LONGEST = 6.0
# Share of a changed region that evidence must span; below it vehicle and shadow look the same and both are kept.
_SPANNED = 0.35
_SOLID = 0.6
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


def _disc(size: float) -> Mask:
    size = max(1, int(size)) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)


def _morph(mask: NDArray[Any], operation: int, size: float) -> Mask:
    return np.asarray(cv2.morphologyEx(mask, operation, _disc(size)), dtype=np.uint8)


def evidence_maps(image: Image, model: BackgroundModel) -> tuple[Mask, Mask, Mask]:
    """Changed pixels, those of them that no shadow explains, and the dark ones; (H, W) uint8 of 0 and 1 each."""
    expected = model.expected(image)
    threshold = model.threshold(expected)
    smooth = cv2.blur(image, (3, 3)).astype(np.float32)
    difference = strongest(cv2.absdiff(smooth, expected))
    changed = difference > np.maximum(threshold, _BORDER_SHARE * cv2.dilate(difference, _disc(5)))
    # Opening with an even kernel shifts by a pixel unless the way back is anchored at the other corner.
    square = np.ones((2, 2), np.uint8)
    opened = cv2.dilate(cv2.erode(changed.view(np.uint8), square, anchor=(1, 1)), square, anchor=(0, 0))
    changed_u8 = np.asarray(opened, dtype=np.uint8)

    light, light_before = lightness(smooth), lightness(expected)
    ratio = (light + 4) / (light_before + 4)
    brighter = light - light_before > threshold
    black = ratio < min(_BLACK[0], _BLACK[1] * model.shadow)
    colour = strongest(cv2.absdiff(smooth, expected * ratio[..., None])) > np.maximum(_COLOUR_LEVELS, threshold * 0.8)
    inside = _morph(changed_u8, cv2.MORPH_ERODE, 2 * _RIM + 1)
    # Outlines of dark things are blurred further inwards than a fixed rim: up to where the difference levels out.
    peak = cv2.dilate(difference, _disc(7))
    blurred = (difference < _LEVEL_SHARE * peak) & (_morph(changed_u8, cv2.MORPH_ERODE, 11) == 0)
    inside[blurred] = 0
    # Texture that the ground has too shows through a shadow.
    new = _range(light, inside) - _range(light_before, np.ones_like(inside)) * np.minimum(ratio, 1)
    textured = np.asarray(new > np.maximum(_TEXTURE_LEVELS, (1 - _LEVEL_SHARE) * peak), dtype=np.bool_)
    return changed_u8, changed_u8 & (brighter | black | colour | textured), changed_u8 & (ratio < _DARK)


def _range(grey: NDArray[np.float32], inside: Mask) -> NDArray[np.float32]:
    """Lightest minus darkest of the pixels inside, in 3 x 3; 0 outside."""
    box = np.ones((3, 3), np.uint8)
    lightest = cv2.dilate(np.where(inside > 0, grey, 0).astype(np.float32), box)
    darkest = cv2.erode(np.where(inside > 0, grey, 255).astype(np.float32), box)
    return np.where(inside > 0, lightest - darkest, 0).astype(np.float32)


def find_silhouettes(image: Image, model: BackgroundModel) -> list[Silhouette]:
    """The vehicles' silhouettes in an image (H, W, 3) uint8 BGR that lies on the model (`BackgroundModel.align`)."""
    assert model.background is not None
    changed, evidence, dark = evidence_maps(image, model)
    min_area = _MIN_AREA_SHARE * changed.size
    found: list[Silhouette] = []
    if changed.mean() > _UPHEAVAL:
        return found
    joined = _morph(changed, cv2.MORPH_CLOSE, 5)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    for i in range(1, count):
        x, y, w, h, area = stats[i].tolist()
        if area < min_area:
            continue
        here = np.s_[y : y + h, x : x + w]
        region = (labels[here] == i).view(np.uint8)
        for part in _vehicles(region, evidence[here] & region, dark[here] & region, min_area):
            px, py, pw, ph = cv2.boundingRect(part)
            around = np.s_[max(0, y + py - 3) : y + py + ph + 3, max(0, x + px - 3) : x + px + pw + 3]
            whole = np.zeros_like(changed[around])
            oy, ox = y + py - around[0].start, x + px - around[1].start
            crop = part[py : py + ph, px : px + pw]
            whole[oy : oy + ph, ox : ox + pw] = crop
            if is_ghost(whole > 0, image[around], model.background[around]):
                continue
            score = float((changed[here][py : py + ph, px : px + pw] & crop).sum() / crop.sum())
            found.append(Silhouette((x + px, y + py), crop > 0, score))
    return found


def _vehicles(region: Mask, evidence: Mask, dark: Mask, min_area: float) -> list[Mask]:
    """The vehicles in one changed region (h, w)."""
    region, evidence, dark = (np.pad(m, _PAD) for m in (region, evidence, dark))
    parts = []
    for piece in _pieces(region, min_area, _CUT_GAIN):
        for part in _spanned(piece, evidence & piece, region.sum()):
            if part.sum() >= 0.3 * min_area:
                parts += _pieces(part, 0.3 * min_area, _CUT_GAIN_EVIDENCE)
    out = []
    for part in _merged(parts, region):
        silhouette = _smooth(part | _roof(part, dark))
        if silhouette is None or silhouette.sum() < min_area:
            continue
        thickness = cv2.distanceTransform(silhouette, cv2.DIST_L2, 3).max()
        if thickness >= max(_THICK * np.sqrt(min_area), np.sqrt(silhouette.sum() / _LONGEST) / 2):
            out.append(silhouette[_PAD:-_PAD, _PAD:-_PAD])
    return [part for part in out if part.any()]


def _spanned(piece: Mask, evidence: Mask, region_area: int) -> list[Mask]:
    """The parts of a piece that evidence spans."""
    area = int(piece.sum())
    reach = min(max(5, 0.3 * np.sqrt(area)), 2 * _PAD - 1)
    spanned = _morph(evidence, cv2.MORPH_CLOSE, reach) & piece
    spanned = _morph(spanned, cv2.MORPH_OPEN, 3)
    if spanned.sum() < _SPANNED * area:
        if area < 0.4 * region_area and evidence.sum() < 0.1 * area:
            return []  # the shadow of the vehicle next to it
        return [piece]
    count, labels = cv2.connectedComponents(spanned)
    return [_morph((labels == i).view(np.uint8), cv2.MORPH_DILATE, 2 * _RIM + 1) & piece for i in range(1, count)]


def _merged(parts: list[Mask], region: Mask) -> list[Mask]:
    """Parts joined where the hull around both is nearly all changed: one vehicle with paint like the road's."""
    parts = sorted(parts, key=lambda part: -int(part.sum()))
    merged = True
    while merged:
        merged = False
        for i, j in itertools.combinations(range(len(parts)), 2):
            hull = _hull(parts[i] | parts[j])
            if (hull & region).sum() >= _ONE_VEHICLE * hull.sum():
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
    roof = _morph(roof, cv2.MORPH_OPEN, 3) | part
    _, labels = cv2.connectedComponents(roof)
    joined: BoolMask = labels == np.bincount(labels[part > 0]).argmax()
    return joined.view(np.uint8)


def _hull(part: Mask) -> Mask:
    points = cv2.findNonZero(part)
    filled = np.zeros_like(part)
    cv2.drawContours(filled, [cv2.convexHull(points).reshape(-1, 1, 2)], -1, 1, cv2.FILLED)
    return filled


def _smooth(part: Mask) -> Mask | None:
    """The part without spurs and dents, or None if it is no solid shape."""
    part = _morph(part, cv2.MORPH_OPEN, max(3, 0.12 * np.sqrt(part.sum())))
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea)
    hull = cv2.convexHull(contour)
    if cv2.contourArea(contour) < _SOLID * cv2.contourArea(hull):
        return None
    filled = np.zeros_like(part)
    cv2.drawContours(filled, [hull], -1, 1, cv2.FILLED)
    return filled


def _pieces(part: Mask, min_area: float, gain: float) -> list[Mask]:
    """A shape, cut where that leaves clearly more convex pieces: vehicles are convex, two of them together are not."""
    opened = _morph(part, cv2.MORPH_OPEN, max(3, 0.06 * np.sqrt(part.sum())))
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
    hull = cv2.convexHull(contour, returnPoints=False)
    try:
        defects = cv2.convexityDefects(contour, np.sort(hull.reshape(-1, 1), axis=0)[::-1])
    except cv2.error:  # OpenCV refuses hulls of contours that touch themselves
        return None
    if defects is None:
        return None
    n = len(contour)
    defects = defects.reshape(-1, 4)  # (N, 1, 4) before OpenCV 5
    deepest = defects[np.argsort(-defects[:, 3], kind="stable")][:2]
    best, best_sum = None, (1 - gain) * whole
    for start in (int(d[2]) for d in deepest if d[3] / 256 > 2):
        rolled = np.roll(contour, -start, axis=0)
        for k in range(n // 10, n - n // 10, max(1, n // 48)):
            one, two = rolled[: k + 1], np.concatenate([rolled[k:], rolled[:1]])
            hulls = cv2.contourArea(cv2.convexHull(one)) + cv2.contourArea(cv2.convexHull(two))
            if hulls < best_sum and min(cv2.contourArea(one), cv2.contourArea(two)) >= _CUT_SHARE * area:
                best, best_sum = (one, two), hulls
    return best
