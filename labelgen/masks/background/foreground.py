"""Per pixel: what differs between an image and the empty scene, and whether a vehicle or a shadow explains it.

A cast shadow darkens the ground, but changes neither its colour nor its texture. So a pixel belongs to a vehicle where
it is brighter than the empty scene, of another colour, darker than the scene's shadows, or textured. Texture counts
only inside a changed region, because the border of a cast shadow is an edge too.

A soft shadow has no such border. A vehicle hides part of the sky, so the road around it is darker, under an overcast
sky for a metre and more, and darkest next to the vehicle. Pixels that can be reached from the open road through such
shade, without crossing an edge, are road.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background.channels import channel_mean, gradient_magnitude
from labelgen.masks.background.model import Difference, colour_residual
from labelgen.masks.background.morphology import Box, Mask, disc, morph

__all__ = ["FOREGROUND", "ForegroundMaps", "ForegroundThresholds", "find_foreground"]

Plane = NDArray[np.float32]


@dataclass(frozen=True)
class ForegroundThresholds:
    """Thresholds that tell vehicles from shadows. Ratios are brightness relative to the empty scene.

    Args:
        rim_px: width of a changed region's border, px, in which texture does not count. A smaller one takes borders of
            cast shadows for texture; a larger one loses texture of small vehicles.
        border_share: a pixel has changed only above this share of the greatest difference within 2 px. It cuts off
            blurred borders; a larger share also cuts off pale parts next to strong ones.
        level_share: share of the greatest difference within 3 px from which on a pixel counts as inside a dark object
            rather than in its blurred border.
        black_ratio: greatest ratio at which a flat pixel is too dark for a shadow. A larger one takes deep shadows for
            vehicles.
        black_shadow_share: the same limit as a share of the scene's typical shadow; the smaller limit holds.
        black_below_shadow: pixels darker than the scene's typical shadow by this ratio are too dark in any case.
        colour_levels: colour residual, grey levels, from which on a pixel is of another colour. Compression noise
            reaches lower values.
        colour_threshold_share: the same limit as a share of the pixel's change threshold; the larger limit holds.
        texture_levels: range of grey levels in 3 x 3 px, beyond that of the empty scene, that counts as texture.
        dark_ratio: greatest ratio of a pixel that may be a vehicle's dark roof.
        shade_ratio: least ratio in a soft shadow.
        shade_slope: greatest gradient of the ratio in a soft shadow, per px; a larger one is an edge.
    """

    rim_px: int = 2
    border_share: float = 0.35
    level_share: float = 0.85
    black_ratio: float = 0.38
    black_shadow_share: float = 0.7
    black_below_shadow: float = 0.17
    colour_levels: float = 14.0
    colour_threshold_share: float = 0.8
    texture_levels: float = 22
    dark_ratio: float = 0.6
    shade_ratio: float = 0.45
    shade_slope: float = 0.025


FOREGROUND = ForegroundThresholds()


@dataclass(frozen=True, eq=False)
class ForegroundMaps:
    """Maps of one part of an image; masks are (h, w) uint8 of 0 and 1.

    Args:
        box: rows and columns of the part in the image.
        changed: pixels that differ from the empty scene and lie in no soft shadow.
        vehicle: changed pixels that no shadow explains.
        dark: changed pixels that are dark.
        shade: (h, w) float32, share by which a pixel is darker than the empty scene; -1 where it is brighter, of
            another colour, or textured.
    """

    box: Box
    changed: Mask
    vehicle: Mask
    dark: Mask
    shade: Plane


def find_foreground(
    difference: Difference, shadow: float, thresholds: ForegroundThresholds = FOREGROUND
) -> ForegroundMaps:
    """Classify the pixels of one part of an image.

    Args:
        difference: the part, compared with the empty scene.
        shadow: typical brightness of a flat cast shadow relative to the ground, see `BackgroundModel.shadow`.
        thresholds: what tells vehicles from shadows.

    Returns:
        The part's maps.
    """
    expected, amount, threshold = difference.expected, difference.amount, difference.threshold
    over = amount > np.maximum(threshold, thresholds.border_share * cv2.dilate(amount, disc(5)))
    # An even kernel shifts the mask by a pixel unless erosion and dilation are anchored at opposite corners.
    square = np.ones((2, 2), np.uint8)
    opened = cv2.dilate(cv2.erode(over.view(np.uint8), square, anchor=(1, 1)), square, anchor=(0, 0))
    changed = np.asarray(opened, dtype=np.uint8)

    light, light_before = channel_mean(difference.smooth), channel_mean(expected)
    ratio = (light + 4) / (light_before + 4)
    residual = colour_residual(difference, ratio)
    changed &= ~_soft_shadow(changed, ratio, residual, difference.open_sides, thresholds)
    brighter = light - light_before > threshold
    black = ratio < max(
        min(thresholds.black_ratio, thresholds.black_shadow_share * shadow), shadow - thresholds.black_below_shadow
    )
    coloured = residual > np.maximum(thresholds.colour_levels, threshold * thresholds.colour_threshold_share)
    inside = morph(changed, cv2.MORPH_ERODE, 2 * thresholds.rim_px + 1)
    # Borders of dark objects are blurred beyond the rim, up to where the difference levels out.
    peak = cv2.dilate(amount, disc(7))
    blurred = (amount < thresholds.level_share * peak) & (morph(changed, cv2.MORPH_ERODE, 11) == 0)
    inside[blurred] = 0
    # Texture of the ground shows through a shadow, so it is subtracted.
    texture = _local_range(light, inside) - _local_range(light_before, np.ones_like(inside)) * np.minimum(ratio, 1)
    textured = texture > np.maximum(thresholds.texture_levels, (1 - thresholds.level_share) * peak)
    certain = brighter | coloured | textured
    shade = np.where(certain, np.float32(-1), 1 - ratio).astype(np.float32)
    dark = changed & (ratio < thresholds.dark_ratio)
    return ForegroundMaps(difference.box, changed, changed & (certain | black), dark, shade)


def _soft_shadow(
    changed: Mask,
    ratio: Plane,
    residual: Plane,
    open_sides: tuple[bool, bool, bool, bool],
    thresholds: ForegroundThresholds,
) -> Mask:
    """Return the changed pixels in a soft shadow: those reached from the open road without crossing an edge."""
    gradual = gradient_magnitude(ratio) / 8 < thresholds.shade_slope
    shade = (ratio < 1) & (ratio > thresholds.shade_ratio) & (residual < thresholds.colour_levels) & gradual
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


def _local_range(grey: Plane, inside: Mask) -> Plane:
    """Return lightest minus darkest of the inside pixels in 3 x 3 px; 0 outside."""
    box = np.ones((3, 3), np.uint8)
    lightest = cv2.dilate(cv2.copyTo(grey, inside), box)
    darkest = cv2.erode(cv2.copyTo(grey, inside, np.full_like(grey, 255)), box)
    return np.asarray(cv2.copyTo(cv2.subtract(lightest, darkest), inside), dtype=np.float32)
