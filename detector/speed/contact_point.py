"""Where a vehicle's near end is, when all that is known is the lowest line of its outline.

The lowest line that a body shows is not the edge of its box on the road. Seen from far away, low above the road, it is
where the tyres stand, most of a metre behind the bumper's front; from nearby and above it is the bumper. Taken for the
edge, it creeps forward while the vehicle comes nearer, and the speed is up to 2 % too high. How far behind the edge it
lies follows from the form of the body: of common ones, at both ends, on average.

Masks by a background model are another matter: they hold the dark road under the bumper as far as nearly the edge, at
any distance, and lose a part of a pixel at their border, which is much road in the distance.

Boxes that a detector has learnt from true 3D boxes end at the edge; this is for outlines.
"""

from __future__ import annotations

from enum import Enum
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import common_bodies
from labelgen.masks.background.source import WORKING_WIDTH

__all__ = ["MaskExtent", "contact_distance_m", "move_to_contact_point"]

# Medians over nine rendered sessions, docs/speed-variants.md: how far before the near end background masks end, and by
# which share of the frame's width too high: half a pixel of those on which they are made.
_SHADE_BEHIND_M, _LOST_SHARE = 0.18, 0.5 / WORKING_WIDTH


class MaskExtent(Enum):
    """What outlines are of."""

    BODY = "body"
    """The vehicle's body: exact masks, and those by a network."""
    BODY_AND_SHADE = "body and shade"
    """The body and the dark road under it: masks by a background model."""


def contact_distance_m(seen_m: ArrayLike, height_m: float) -> Array:
    """Distances of near ends from those of the lowest lines.

    A point of the body s behind its end and z above the road is seen, from a height h, where the road is
    (distance + s) h / (h - z) away; the lowest line is the nearest of these.

    Args:
        seen_m: (N,) how far along the road from the camera the lowest lines seem to lie, > 0.
        height_m: of the camera above the road.

    Returns:
        (N,) metres along the road; unchanged where the camera is hardly higher than a vehicle.
    """
    seen = np.asarray(seen_m, dtype=np.float64)
    out = np.zeros_like(seen)
    for share, behind_m, above_m in _ends():
        if above_m.max() >= height_m:
            return seen
        out += share * (seen[..., None] * (1 - above_m / height_m) - behind_m).max(axis=-1)
    return out


def move_to_contact_point(camera: Camera, points_px: Array, outline: MaskExtent = MaskExtent.BODY) -> Array:
    """Points (N, 2) px on the lowest lines of outlines, moved along the road to the vehicles' near ends."""
    with_shade = outline is MaskExtent.BODY_AND_SHADE
    lost = _LOST_SHARE * camera.image_wh[0] if with_shade and camera.image_wh else 0.0
    places = camera.road_points(points_px + np.array([0.0, lost]), invalid="nan")
    ahead = places[:, 0] > 0
    seen = places[ahead, 0]
    places[ahead, 0] = seen - _SHADE_BEHIND_M if with_shade else contact_distance_m(seen, camera.height_m)
    return np.where(ahead[:, None], camera.project(places), points_px)


@cache
def _ends() -> tuple[tuple[float, Array, Array], ...]:
    """Fronts and rears of common bodies: share in traffic; how far points lie behind the end and above the road, m."""
    found = []
    for body in common_bodies():
        for along in (body.points[:, 0], -body.points[:, 0]):
            found.append((body.share / 2, along.max() - along, body.points[:, 2]))
    return tuple(found)
