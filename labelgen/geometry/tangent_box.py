"""Tangent boxes: the 3D box of a vehicle whose edges touch its outline in the frame and meet in the vanishing points.

Each outline is rectified in a window of its own. There the tangents through VP2 and VP3 are the sides of a rectangle
and those through VP1 are the tangents from VPU, so that `outline_label` and `box_codec` give the box. The position of
VPU decides which side of the vehicle is visible.

Convention:
    Frame px, float64, x right, y down; vertices (N, 8, 2) in the order of `labelgen.geometry.box_codec`.

Source: Dubska et al., BMVC 2014, section 3.2. Five of the six tangents define a box; as there, the larger of the two
possible boxes is taken (`Rule.WIDER`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.choices import Pair, Rule
from labelgen.errors import RectificationError
from labelgen.geometry.box_codec import decode_boxes
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array, bounding_boxes
from labelgen.geometry.outline_label import label_outlines, polygon_outline
from labelgen.geometry.rectification import Rectification

__all__ = ["tangent_boxes", "window_around"]

_MARGIN_PX = 4
"""Widens each side of the window, so that its border does not cut the outline's tangents."""
_MIN_SIDE_PX = 32
"""Least side of the rectified window: smaller ones would be coarser than the outline."""


def window_around(camera: Camera, box_xyxy: ArrayLike, pair: Pair = Pair.VP2_VP3) -> Rectification:
    """Return a rectification of the part of the frame around one vehicle, at about the frame's resolution.

    Args:
        camera: of the frame.
        box_xyxy: (4,) frame px.
        pair: the vanishing points whose directions become axis-parallel.

    Raises:
        RectificationError: the line that joins the two vanishing points crosses the window.
    """
    window = np.asarray(box_xyxy, dtype=np.float64) + _MARGIN_PX * np.array([-1, -1, 1, 1])
    size = np.maximum(window[2:] - window[:2], _MIN_SIDE_PX).tolist()
    return Rectification.from_window(camera, window, pair, (size[0], size[1]))


def tangent_boxes(
    camera: Camera, polygons_px: Sequence[Array], pair: Pair = Pair.VP2_VP3, rule: Rule = Rule.WIDER
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the 3D boxes tangent to N outlines.

    Args:
        camera: of the frame; it needs no scale.
        polygons_px: N arrays (K, 2) frame px whose convex hulls are the outlines.
        pair: the vanishing points whose four tangents all define the box; of the two through the third one does.
        rule: how the candidates from those two become one.

    Returns:
        Vertices (N, 8, 2), frame px, and valid (N,) bool. Vertices are NaN where an outline admits no box.
    """
    vertices = np.full((len(polygons_px), 8, 2), np.nan)
    for i, polygon in enumerate(polygons_px):
        try:
            window = window_around(camera, bounding_boxes(polygon), pair)
        except RectificationError:
            continue
        outline = polygon_outline(window, polygon)
        if outline is None:
            continue
        label = label_outlines([outline], window.vpu, rule)
        decoded, fits = decode_boxes(label.boxes_xyxy, label.cc, window.vpu)
        if fits[0] and label.valid[0]:
            vertices[i] = window.points_back(decoded[0])
    return vertices, np.isfinite(vertices).all(axis=(1, 2))
