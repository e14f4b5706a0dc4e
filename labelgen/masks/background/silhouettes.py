"""Silhouettes of the vehicles in an image, found by comparison with the empty scene.

The silhouette of a vehicle is the part of a changed region that its vehicle pixels span, see
`labelgen.masks.background.foreground`, without the shade on the road under its front.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.convex_pieces import CUTS, convex_pieces
from labelgen.masks.background.foreground import FOREGROUND, ForegroundMaps, find_foreground
from labelgen.masks.background.model import BackgroundModel, is_ghost
from labelgen.masks.background.morphology import Mask, fill_holes, fill_hull, morph

__all__ = ["SILHOUETTES", "Silhouette", "SilhouetteThresholds", "find_silhouettes"]

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]
BoolMask = NDArray[np.bool_]

# Border around each region, px, so that morphology does not reach its window's sides.
_PAD_PX = 16


@dataclass(frozen=True)
class SilhouetteThresholds:
    """Thresholds from changed regions to silhouettes. A part's size is the square root of its area.

    Args:
        min_area_share: area of the smallest silhouette as a share of the image's. A smaller one finds vehicles farther
            away, and more noise.
        max_changed_share: with more of the image changed, the camera has moved or the light has switched, and there
            are no silhouettes.
        min_piece_share: least area of a piece before pieces are joined, as a share of the smallest silhouette's.
        reach_share: gaps between vehicle pixels are closed up to this share of the size of the changed region.
        min_reach_px: the same, at least, px.
        min_spanned_share: share of a changed region that vehicle pixels must span. Below it vehicle and shadow look
            the same, and the whole region is kept.
        shadow_area_share: a piece smaller than this share of its region may be the shadow of the vehicle beside it...
        shadow_vehicle_share: ... if its vehicle pixels are less than this share of the piece.
        joined_share: parts are one vehicle if this share of the convex hull around them has changed. A smaller share
            joins vehicles side by side.
        roof_height_share: dark pixels above a part belong to its roof up to this share of the part's height.
        spur_share: spurs narrower than this share of the part's size are cut off.
        min_solidity: least share of its convex hull that a silhouette fills.
        shade_share: pixels less shaded than this share of the deepest shade near them are road, not vehicle.
        shade_above_share: reach of "near" upwards, as a share of the part's size.
        shade_beside_share: reach of "near" to both sides, as a share of the part's size.
        max_shade_area_share: where more than this share of a part would be taken for shade, nothing is removed.
        min_thickness_share: least half width of the thickest place, as a share of the side of the smallest
            silhouette. Edges of lane lines are thinner.
        max_elongation: greatest length of a vehicle as a multiple of its width.
    """

    min_area_share: float = 0.0006
    max_changed_share: float = 0.7
    min_piece_share: float = 0.3
    reach_share: float = 0.3
    min_reach_px: float = 5
    min_spanned_share: float = 0.35
    shadow_area_share: float = 0.4
    shadow_vehicle_share: float = 0.1
    joined_share: float = 0.9
    roof_height_share: float = 0.7
    spur_share: float = 0.12
    min_solidity: float = 0.6
    shade_share: float = 0.8
    shade_above_share: float = 0.12
    shade_beside_share: float = 0.1
    max_shade_area_share: float = 0.4
    min_thickness_share: float = 0.3
    max_elongation: float = 6.0


SILHOUETTES = SilhouetteThresholds()


@dataclass(frozen=True)
class Silhouette:
    """Silhouette of one vehicle.

    Args:
        origin: px (x, y) of the crop's first pixel in the image.
        crop: (h, w) bool.
        score: share of its pixels that differ from the empty scene; the others were filled in.
    """

    origin: tuple[int, int]
    crop: BoolMask
    score: float


def find_silhouettes(
    image: Image, model: BackgroundModel, thresholds: SilhouetteThresholds = SILHOUETTES
) -> list[Silhouette]:
    """Find the vehicles' silhouettes in an image.

    Args:
        image: (H, W, 3) uint8 BGR, aligned with the model (`BackgroundModel.align`).
        model: the empty scene.
        thresholds: of this stage.
    """
    maps = [find_foreground(part, model.shadow) for part in model.differences(image)]
    area = image.shape[0] * image.shape[1]
    if sum(cv2.countNonZero(part.changed) for part in maps) > thresholds.max_changed_share * area:
        return []
    min_area = thresholds.min_area_share * area
    return [silhouette for part in maps for silhouette in _in_part(part, image, model, min_area, thresholds)]


def _in_part(
    part: ForegroundMaps, image: Image, model: BackgroundModel, min_area: float, thresholds: SilhouetteThresholds
) -> list[Silhouette]:
    """Find the silhouettes in one part of an image."""
    assert model.background is not None
    regions = fill_holes(morph(part.changed, cv2.MORPH_CLOSE, 5))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(regions)
    labels, vehicle, dark, shade = (_pad(m) for m in (labels, part.vehicle, part.dark, part.shade))
    top, left = part.box[0].start, part.box[1].start
    silhouettes: list[Silhouette] = []
    for i in range(1, count):
        x, y, w, h, area = stats[i].tolist()
        if area < min_area:
            continue
        window = np.s_[y : y + h + 2 * _PAD_PX, x : x + w + 2 * _PAD_PX]
        region = (labels[window] == i).view(np.uint8)
        masks = _vehicles(region, vehicle[window] & region, dark[window] & region, shade[window], min_area, thresholds)
        for mask in masks:
            px, py, pw, ph = cv2.boundingRect(mask)
            crop = mask[py : py + ph, px : px + pw]
            px, py = px + x - _PAD_PX, py + y - _PAD_PX
            origin = left + px, top + py
            if _is_ghost(crop, origin, image, model.background):
                continue
            changed_area = cv2.countNonZero(part.changed[py : py + ph, px : px + pw] & crop)
            silhouettes.append(Silhouette(origin, crop > 0, changed_area / cv2.countNonZero(crop)))
    return silhouettes


def _pad(picture: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(cv2.copyMakeBorder(picture, _PAD_PX, _PAD_PX, _PAD_PX, _PAD_PX, cv2.BORDER_CONSTANT, value=0))


def _is_ghost(crop: Mask, origin: tuple[int, int], image: Image, background: Plane) -> bool:
    (x, y), (h, w) = origin, crop.shape
    window = np.s_[max(0, y - 3) : y + h + 3, max(0, x - 3) : x + w + 3]
    mask = np.zeros(image[window].shape[:2], dtype=np.bool_)
    oy, ox = y - window[0].start, x - window[1].start
    mask[oy : oy + h, ox : ox + w] = crop
    return is_ghost(mask, image[window], background[window])


def _vehicles(
    region: Mask, vehicle: Mask, dark: Mask, shade: Plane, min_area: float, thresholds: SilhouetteThresholds
) -> list[Mask]:
    """Find the vehicles in one changed region.

    Args:
        region: (h, w), at least `_PAD_PX` away from all sides.
        vehicle, dark, shade: (h, w), see `ForegroundMaps`; `vehicle` and `dark` within the region.
        min_area: area of the smallest silhouette, px.
        thresholds: of this stage.

    Returns:
        (h, w) masks.
    """
    parts = []
    min_piece_area = thresholds.min_piece_share * min_area
    for piece in convex_pieces(region, min_area, CUTS.region_gain):
        for part in _spanned(piece, vehicle & piece, cv2.countNonZero(region), thresholds):
            if cv2.countNonZero(part) >= min_piece_area:
                parts += convex_pieces(part, min_piece_area, CUTS.vehicle_gain)
    masks = []
    for part in _join(parts, region, thresholds):
        mask = _smooth(part | _roof(part, dark, thresholds), thresholds)
        if mask is not None:
            mask = _remove_shade(mask, shade, thresholds)
        if mask is None or cv2.countNonZero(mask) < min_area:
            continue
        thickness = cv2.distanceTransform(mask, cv2.DIST_L2, 3).max()
        min_thickness = thresholds.min_thickness_share * np.sqrt(min_area)
        if thickness >= max(min_thickness, np.sqrt(cv2.countNonZero(mask) / thresholds.max_elongation) / 2):
            masks.append(mask)
    return masks


def _spanned(piece: Mask, vehicle: Mask, region_area: int, thresholds: SilhouetteThresholds) -> list[Mask]:
    """Return the parts of a piece that its vehicle pixels span; none where it is a shadow."""
    area = cv2.countNonZero(piece)
    reach_px = min(max(thresholds.min_reach_px, thresholds.reach_share * np.sqrt(area)), 2 * _PAD_PX - 1)
    spanned = morph(vehicle, cv2.MORPH_CLOSE, reach_px) & piece
    spanned = morph(spanned, cv2.MORPH_OPEN, 3)
    if cv2.countNonZero(spanned) < thresholds.min_spanned_share * area:
        is_small = area < thresholds.shadow_area_share * region_area
        if is_small and cv2.countNonZero(vehicle) < thresholds.shadow_vehicle_share * area:
            return []  # the shadow of the vehicle next to it
        return [piece]
    count, labels = cv2.connectedComponents(spanned)
    grow_px = 2 * FOREGROUND.rim_px + 1
    return [morph((labels == i).view(np.uint8), cv2.MORPH_DILATE, grow_px) & piece for i in range(1, count)]


def _join(parts: list[Mask], region: Mask, thresholds: SilhouetteThresholds) -> list[Mask]:
    """Join parts where the hull around both is nearly all changed: one vehicle with paint like the road's."""
    parts = sorted(parts, key=lambda part: -cv2.countNonZero(part))
    has_joined = True
    while has_joined:
        has_joined = False
        for i, j in itertools.combinations(range(len(parts)), 2):
            hull = fill_hull(parts[i] | parts[j])
            if cv2.countNonZero(hull & region) >= thresholds.joined_share * cv2.countNonZero(hull):
                parts[i] = parts[i] | parts.pop(j)
                has_joined = True
                break
    return parts


def _roof(part: Mask, dark: Mask, thresholds: SilhouetteThresholds) -> Mask:
    """Return a part with the dark pixels right above it: shadows lie beside and below, so these are its roof."""
    x, y, w, h = cv2.boundingRect(part)
    margin = w // 8
    roof = np.zeros_like(part)
    above = np.s_[max(0, y - int(thresholds.roof_height_share * h)) : y + h // 2, x + margin : x + w - margin]
    roof[above] = dark[above]
    roof = morph(roof, cv2.MORPH_OPEN, 3) | part
    _, labels = cv2.connectedComponents(roof)
    joined: BoolMask = labels == np.bincount(labels[part > 0]).argmax()
    return joined.view(np.uint8)


def _smooth(part: Mask, thresholds: SilhouetteThresholds) -> Mask | None:
    """Return the convex hull of a part without its spurs; None if the part is not solid."""
    spur_px = max(3, thresholds.spur_share * np.sqrt(cv2.countNonZero(part)))
    # Opening rounds corners off. The dilation gives the corners back, but of a spur only its root.
    part = part & morph(morph(part, cv2.MORPH_OPEN, spur_px), cv2.MORPH_DILATE, spur_px / 2)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    contour = max(contours, key=cv2.contourArea)
    hull = cv2.convexHull(contour)
    if cv2.contourArea(contour) < thresholds.min_solidity * cv2.contourArea(hull):
        return None
    out = np.zeros_like(part)
    cv2.drawContours(out, [hull], -1, 1, cv2.FILLED)
    return out


def _remove_shade(part: Mask, shade: Plane, thresholds: SilhouetteThresholds) -> Mask | None:
    """Return a part without the shade on the road below it.

    Shade deepens towards the vehicle, so its lower pixels are less shaded than those above them.
    """
    x, y, w, h = cv2.boundingRect(part)
    window = np.s_[y : y + h, x : x + w]
    inside, part_shade = part[window] > 0, np.where(part[window] > 0, shade[window], 0)
    size = np.sqrt(float(cv2.countNonZero(part)))
    above, beside = max(2, int(thresholds.shade_above_share * size)), max(1, int(thresholds.shade_beside_share * size))
    kernel = np.ones((above + 1, 2 * beside + 1), np.uint8)
    deepest = cv2.dilate(
        np.maximum(part_shade, 0), kernel, anchor=(beside, above), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    is_road = ~inside | ((part_shade >= 0) & (part_shade < thresholds.shade_share * deepest))
    below = np.logical_and.accumulate(is_road[::-1], axis=0)[::-1]
    rest = np.zeros_like(part)
    rest[window] = inside & ~below
    min_rest_area = (1 - thresholds.max_shade_area_share) * cv2.countNonZero(part)
    return _smooth(rest, thresholds) if cv2.countNonZero(rest) >= min_rest_area else part
