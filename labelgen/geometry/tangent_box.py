"""The 3D box of a vehicle whose sides touch its outline in the frame, along the three vanishing points.

Each outline is rectified in a window of its own, where the tangents through VP2 and VP3 are the sides of a rectangle
and those through VP1 are the tangents from VPU; `mask_label` and `box3d` do the rest. Which side of the vehicle is
seen, that towards VP1's left or right, follows from where VPU lies.

Source: Dubska et al., BMVC 2014, section 3.2 (the construction); of six tangents one is too many, and as there the
larger of the two boxes is taken (`Rule.WIDER`).
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
_SMALLEST_PX = 32


def window_around(camera: Camera, box_xyxy: ArrayLike, pair: Pair = Pair.VP2_VP3) -> Rectification:
    """Rectification of the part of the frame around one vehicle.

    Nothing is cut at a rectified picture's border there, or sampled coarsely.

    Args:
        camera: of the frame.
        box_xyxy: (4,) frame px.
        pair: the vanishing points made axis-parallel.

    Raises:
        RectificationError: the window lies on the line that joins them.
    """
    window = np.asarray(box_xyxy, dtype=np.float64) + _MARGIN_PX * np.array([-1, -1, 1, 1])
    size = np.maximum(window[2:] - window[:2], _SMALLEST_PX).tolist()
    return Rectification.from_window(camera, window, pair, (size[0], size[1]))


def tangent_boxes(
    camera: Camera, polygons_px: Sequence[Array], pair: Pair = Pair.VP2_VP3, rule: Rule = Rule.WIDER
) -> tuple[Array, NDArray[np.bool_]]:
    """The boxes tangent to N outlines.

    Args:
        camera: of the frame; it needs no scale.
        polygons_px: N arrays (K, 2) frame px whose convex hulls are the outlines.
        pair: the vanishing points whose tangents all count; of those through the third, one does.
        rule: which one.

    Returns:
        vertices (N, 8, 2) frame px in the order of `box3d`, and valid (N,): False, with NaN vertices, where an outline
        admits no box.
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
