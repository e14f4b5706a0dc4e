"""What differs between an image and its empty scene, pixel by pixel, and whether that is a vehicle or its shadow.

A shadow darkens without changing colour and without adding texture, so what is brighter, coloured, darker than the
scene's shadows, or textured *inside* a changed region is evidence for a vehicle. An outline alone is no evidence: cast
shadows have one too. Soft shadows have none: the sky that a vehicle hides leaves a shade around it, under a grey sky
for a metre and more, that deepens towards the vehicle. What is reached through it from the open road without crossing
an edge is road.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.model import Difference, lightness, slope, stain
from labelgen.masks.background.morphology import Box, Mask, disc, morph

__all__ = ["RIM", "Evidence", "find_evidence"]

Plane = NDArray[np.float32]

RIM = 2
"""Within so many px of a changed region's outline texture is no evidence."""
# Blurred borders are cut where the difference falls below this share of what it is 2 px further inside.
_BORDER_SHARE = 0.35
_LEVEL_SHARE = 0.85
# Nothing flat is so dark without being a vehicle: at most this, and this far below the scene's typical shadow.
_BLACK, _BELOW_SHADOW = 0.38, 0.17
_BLACK_SHARE = 0.7
_COLOUR_LEVELS = 14.0
_TEXTURE_LEVELS = 22
_DARK = 0.6
# Shade is at least so bright relative to the road, and deepens by at most so much per px.
_SHADE, _SHADE_SLOPE = 0.45, 0.025


@dataclass(frozen=True, eq=False)
class Evidence:
    """Maps of a part of one image; masks are (h, w) uint8 of 0 and 1.

    Args:
        box: where the part lies.
        changed: what differs from the empty scene and is no soft shadow.
        vehicle: those of them that no shadow explains.
        dark: those of them that are dark.
        shade: (h, w) float32, by which share a pixel is darker than the empty scene; -1 where it is brighter,
            of another colour, or textured.
    """

    box: Box
    changed: Mask
    vehicle: Mask
    dark: Mask
    shade: Plane


def find_evidence(seen: Difference, shadow: float) -> Evidence:
    """The evidence in a part of an image.

    Args:
        seen: the part.
        shadow: how bright a flat cast shadow typically is, relative to the ground without it.
    """
    smooth, expected, difference, threshold = seen.smooth, seen.expected, seen.amount, seen.threshold
    over = difference > np.maximum(threshold, _BORDER_SHARE * cv2.dilate(difference, disc(5)))
    # Opening with an even kernel shifts by a pixel unless the way back is anchored at the other corner.
    square = np.ones((2, 2), np.uint8)
    opened = cv2.dilate(cv2.erode(over.view(np.uint8), square, anchor=(1, 1)), square, anchor=(0, 0))
    changed = np.asarray(opened, dtype=np.uint8)

    light, light_before = lightness(smooth), lightness(expected)
    ratio = (light + 4) / (light_before + 4)
    stained = stain(seen, ratio)
    changed &= ~_soft_shadow(changed, ratio, stained, seen.open_sides)
    brighter = light - light_before > threshold
    black = ratio < max(min(_BLACK, _BLACK_SHARE * shadow), shadow - _BELOW_SHADOW)
    colour = stained > np.maximum(_COLOUR_LEVELS, threshold * 0.8)
    inside = morph(changed, cv2.MORPH_ERODE, 2 * RIM + 1)
    # Outlines of dark things are blurred further inwards than a fixed rim: up to where the difference levels out.
    peak = cv2.dilate(difference, disc(7))
    blurred = (difference < _LEVEL_SHARE * peak) & (morph(changed, cv2.MORPH_ERODE, 11) == 0)
    inside[blurred] = 0
    # Texture that the ground has too shows through a shadow.
    new = _range(light, inside) - _range(light_before, np.ones_like(inside)) * np.minimum(ratio, 1)
    textured = new > np.maximum(_TEXTURE_LEVELS, (1 - _LEVEL_SHARE) * peak)
    firm = brighter | colour | textured
    shade = np.where(firm, np.float32(-1), 1 - ratio).astype(np.float32)
    return Evidence(seen.box, changed, changed & (firm | black), changed & (ratio < _DARK), shade)


def _soft_shadow(changed: Mask, ratio: Plane, stained: Plane, open_sides: tuple[bool, bool, bool, bool]) -> Mask:
    """The changed pixels that lie in a soft shadow: reached from the open road without crossing an edge."""
    shade = (ratio < 1) & (ratio > _SHADE) & (stained < _COLOUR_LEVELS) & (slope(ratio) / 8 < _SHADE_SLOPE)
    passable = (shade | (changed == 0)).view(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(passable, connectivity=4)
    if count < 2:
        return np.zeros_like(changed)
    # Nothing has changed along a side beyond which the frame goes on.
    corners = (labels[0, 0], labels[-1, 0], labels[0, 0], labels[0, -1])
    roads = {int(label) for label, is_open in zip(corners, open_sides, strict=True) if is_open}
    roads = roads or {1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())}
    is_road = np.zeros(count, dtype=np.uint8)
    is_road[list(roads)] = 1
    return np.asarray(is_road[labels] & changed, dtype=np.uint8)


def _range(grey: Plane, inside: Mask) -> Plane:
    """Lightest minus darkest of the pixels inside, in 3 x 3; 0 outside."""
    box = np.ones((3, 3), np.uint8)
    lightest = cv2.dilate(cv2.copyTo(grey, inside), box)
    darkest = cv2.erode(cv2.copyTo(grey, inside, np.full_like(grey, 255)), box)
    return np.asarray(cv2.copyTo(cv2.subtract(lightest, darkest), inside), dtype=np.float32)
