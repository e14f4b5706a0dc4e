"""Outlines of masks as measurements: the planes through the camera's centre that touch a vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.labeling.fitted.settings import BodyFitSettings

__all__ = ["Outlines", "measure_outlines"]


@dataclass(frozen=True, eq=False)
class Outlines:
    """R outlines, each measured in M directions of the image.

    Args:
        reach_px: (R, M) how far each reaches.
        normals: (R, M, 3) of the planes through the camera's centre, road frame, pointing out of the vehicle; of such
            length that a metre along the normal at a depth of f is a pixel.
        sizes_px: (R,) square root of the area of the box around it.
        bottoms_px: (R, 2) middle of the box's lower side.
        widths_px, heights_px: (R,) of the box.
        open: (R, M) bool, where the picture's border cuts the outline: the vehicle may reach farther.
    """

    reach_px: Array
    normals: Array
    sizes_px: Array
    bottoms_px: Array
    widths_px: Array
    heights_px: Array
    open: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.sizes_px)

    def select(self, rows: NDArray[np.int64]) -> Outlines:
        """Return some of the outlines, by number (K,)."""
        return Outlines(*(getattr(self, f.name)[rows] for f in fields(self)))


def measure_outlines(
    polygons_px: Sequence[Array],
    camera: Camera,
    frame_wh: tuple[int, int],
    settings: BodyFitSettings,
    *,
    margin_px: float = 1.5,
) -> Outlines:
    """Measure outlines.

    Args:
        polygons_px: R arrays (K, 2), frame px, points whose convex hull is the outline.
        camera: with a scale.
        frame_wh: width, height of the frame, px.
        settings: of the fit.
        margin_px: an outline that comes as near to the picture's border may go on beyond it, px. Masks that are made on
            a smaller picture, or by a network, end farther from it.
    """
    directions = settings.direction_vectors
    count, m = len(polygons_px), settings.directions
    reach, farthest = np.zeros((count, m)), np.zeros((count, m, 2))
    low, high = np.zeros((count, 2)), np.zeros((count, 2))
    for r, polygon in enumerate(polygons_px):
        along = polygon @ directions.T
        last = along.argmax(axis=0)
        reach[r], farthest[r] = along[last, np.arange(m)], polygon[last]
        low[r], high[r] = polygon.min(axis=0), polygon.max(axis=0)
    size = np.asarray(frame_wh, dtype=np.float64)
    beyond = (farthest < margin_px) & (directions < 0) | (farthest > size - margin_px) & (directions > 0)
    in_camera = np.concatenate(
        [np.broadcast_to(directions, (count, m, 2)), -((reach - directions @ camera.pp) / camera.focal)[..., None]], -1
    )
    return Outlines(
        reach,
        in_camera @ camera.axes.T,
        np.sqrt((high - low).prod(axis=1)),
        np.stack([(low[:, 0] + high[:, 0]) / 2, high[:, 1]], axis=1),
        high[:, 0] - low[:, 0],
        high[:, 1] - low[:, 1],
        np.asarray(beyond.any(axis=-1)),
    )
