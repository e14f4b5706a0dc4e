"""The contact point of a vehicle, from the lowest line of its mask.

The contact point is the middle of the bottom edge of the 3D box at its near end, on the road. Masks do not end there:

- A mask of the body ends, seen from far away, where the tyres stand, up to 0.9 m behind that edge; seen from nearby and
  above, it ends at the bumper. Its lowest line moves towards the edge while the vehicle comes nearer, and the measured
  speed is up to 2 % too high. How far the line lies behind the edge follows from the form of the body; the mean over
  both ends of common bodies (`labelgen.geometry.vehicle_bodies`) is taken here.
- A mask by a background model also covers the dark road under the bumper, at any distance, and loses a part of a pixel
  at its border, which is much road in the distance.

A box that a detector has learned from true 3D boxes ends at the edge; nothing here applies to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import common_bodies
from labelgen.masks.background.source import WORKING_WIDTH

__all__ = ["ContactRules", "MaskExtent", "contact_distance_m", "move_to_contact_point"]


@dataclass(frozen=True)
class ContactRules:
    """Offsets of masks by a background model, from nine rendered sessions (docs/studies/speed-variants.md).

    Args:
        shade_behind_m: metres; the mask ends this far behind the near end, on the dark road under the bumper. It is the
            median; single masks end 0.1 to 0.4 m behind. The same offset everywhere shifts places, not speeds.
        lost_px: pixels of the width `mask_width_px`; the border of the mask lies this much too high. More of it lowers
            the speeds of distant vehicles, less of it raises them.
        mask_width_px: pixels; width of the frames on which the background model makes its masks.
    """

    shade_behind_m: float = 0.18
    lost_px: float = 0.5
    mask_width_px: int = WORKING_WIDTH


_RULES = ContactRules()


class MaskExtent(Enum):
    """What masks cover of a vehicle and of the road around it. The values stand in files of detections."""

    BODY = "body"
    """The body of the vehicle: exact masks, and those by a network."""
    BODY_AND_SHADE = "body and shade"
    """The body and the dark road under it: masks by a background model."""


def contact_distance_m(lowest_m: ArrayLike, height_m: float) -> Array:
    """Return the distances of contact points from those of the lowest lines of bodies.

    A point of the body, s behind its near end and z above the road, is seen by a camera at height h where the road is
    (distance + s) h / (h - z) away. The lowest line is the nearest of these.

    Args:
        lowest_m: (N,) metres, > 0; distance along the road from the camera to where the lowest lines appear to lie.
        height_m: metres; height of the camera above the road.

    Returns:
        (N,) metres along the road; `lowest_m` itself where the camera is not higher than a common body.
    """
    lowest = np.asarray(lowest_m, dtype=np.float64)
    out = np.zeros_like(lowest)
    for share, behind_m, above_m in _ends():
        if above_m.max() >= height_m:
            return lowest
        out += share * (lowest[..., None] * (1 - above_m / height_m) - behind_m).max(axis=-1)
    return out


def move_to_contact_point(
    camera: Camera, points_px: Array, extent: MaskExtent = MaskExtent.BODY, rules: ContactRules = _RULES
) -> Array:
    """Move points from the lowest lines of masks along the road to the contact points of the vehicles.

    Args:
        camera: with a scale.
        points_px: (N, 2) frame px.
        extent: what the masks cover.
        rules: offsets of masks by a background model.

    Returns:
        (N, 2) frame px; unchanged where a point is not on the road ahead of the camera.
    """
    with_shade = extent is MaskExtent.BODY_AND_SHADE
    lost_px = rules.lost_px / rules.mask_width_px * camera.image_wh[0] if with_shade and camera.image_wh else 0.0
    places = camera.road_points(points_px + np.array([0.0, lost_px]), invalid="nan")
    ahead = places[:, 0] > 0
    lowest = places[ahead, 0]
    places[ahead, 0] = lowest - rules.shade_behind_m if with_shade else contact_distance_m(lowest, camera.height_m)
    return np.where(ahead[:, None], camera.project(places), points_px)


@cache
def _ends() -> tuple[tuple[float, Array, Array], ...]:
    """Return front and rear of each common body: share in traffic; points' distance behind the end and height, m."""
    ends = []
    for body in common_bodies():
        for along in (body.points[:, 0], -body.points[:, 0]):
            ends.append((body.share / 2, along.max() - along, body.points[:, 2]))
    return tuple(ends)
