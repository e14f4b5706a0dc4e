"""The label codec: 3D boxes in a rectified image <-> axis-aligned 2D boxes and one number c_c.

Convention:
    Boxes are (N, 4) float64 as x0, y0, x1, y1; vertices (N, 8, 2) float64 as x, y; both in px of the rectified
    image, x right, y down.
    Vertices stand in the order of BoxCars116k: 0-3 top, 4-7 bottom beneath them; 0, 1 top front edge, 1, 2 top edge
    of the visible side, 2, 3 top rear edge. "Front" is the face nearer to the bottom of the rectified image.
    c_c is (N,) float64 in [0, 1]: (y of the top front edge - y0) / (y1 - y0).

The 3D box is one axis-aligned rectangle, the face away from VPU, and the same rectangle scaled towards VPU by a
factor s, 0 < s <= 1. With y flipped where VPU lies below, one formula serves both positions of VPU; its maximum and
minimum give the six published cases.

Source: Kocur & Ftacnik 2020, section 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.geometry.homography import Array, bounding_boxes

__all__ = ["EncodedBoxes", "decode_boxes", "encode_boxes", "front_bottom_midpoints", "reorder_vertices"]

_TOP_ORDERS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [3, 2, 1, 0], [2, 3, 0, 1]])
_VERTEX_ORDERS = np.concatenate([_TOP_ORDERS, _TOP_ORDERS + 4], axis=1)
"""Vertex permutations, indexed by mirrored + 2 * reversed; each is its own inverse."""


@dataclass(frozen=True)
class EncodedBoxes:
    """N encoded boxes, with what is needed to give decoded vertices their old order.

    Args:
        boxes_xyxy: (N, 4) rectified px, the box around the 8 vertices.
        cc: (N,) c_c; NaN for a box without height.
        mirrored: (N,) True where vertices 0 and 1 are swapped compared with those of `decode_boxes`.
        reversed: (N,) True where edge 2, 3 is the near one: a vehicle seen from behind whose vertices start at its
            own front.
    """

    boxes_xyxy: Array
    cc: Array
    mirrored: NDArray[np.bool_]
    reversed: NDArray[np.bool_]


def encode_boxes(vertices: ArrayLike, vpu: ArrayLike) -> EncodedBoxes:
    """Encode 3D boxes of a rectified image as 2D boxes and c_c.

    Args:
        vertices: (N, 8, 2) rectified px; edges point to the rectified vanishing points.
        vpu: (2,) or (N, 2) rectified px, the vanishing point that the rectification leaves finite.

    Returns:
        The N boxes. Vertices that follow the vanishing points are restored by `decode_boxes`, then `reorder_vertices`.
    """
    points = np.asarray(vertices, dtype=np.float64).reshape(-1, 8, 2)
    u = np.broadcast_to(np.asarray(vpu, dtype=np.float64), (len(points), 2))[:, 0]
    boxes = bounding_boxes(points)
    front, rear = points[:, :2, 1].mean(axis=1), points[:, 2:4, 1].mean(axis=1)
    backwards = front < rear
    with np.errstate(divide="ignore", invalid="ignore"):
        cc = (np.maximum(front, rear) - boxes[:, 1]) / (boxes[:, 3] - boxes[:, 1])
    left, right = points[:, [0, 3, 4, 7], 0].mean(axis=1), points[:, [1, 2, 5, 6], 0].mean(axis=1)
    # Vertices 1 and 2 belong on the side that VPU lies on.
    mirrored = (right > left) == (u < (boxes[:, 0] + boxes[:, 2]) / 2)
    return EncodedBoxes(boxes, cc, mirrored, backwards)


def decode_boxes(boxes_xyxy: ArrayLike, cc: ArrayLike, vpu: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Decode 2D boxes and c_c into 3D boxes of the rectified image.

    Args:
        boxes_xyxy: (N, 4) rectified px.
        cc: (N,) c_c in [0, 1].
        vpu: (2,) or (N, 2) rectified px, the vanishing point that the rectification leaves finite.

    Returns:
        Vertices (N, 8, 2), rectified px, and valid (N,) bool. Not valid is a box into which no 3D box with this c_c
        fits; its vertices are undefined and may be NaN.
    """
    box = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4).T
    cc = np.asarray(cc, dtype=np.float64).reshape(-1)
    u, v = np.asarray(vpu, dtype=np.float64).reshape(-1, 2).T
    below = v > (box[1] + box[3]) / 2
    flip = np.where(below, -1.0, 1.0)
    y0, y1 = np.where(below, -box[3], box[1]), np.where(below, -box[1], box[3])
    v = flip * v
    with np.errstate(divide="ignore", invalid="ignore"):
        c = flip * (box[1] + cc * (box[3] - box[1]))
        s = (y0 - v) / (c - v)
        left = np.maximum(box[0], u + (box[0] - u) / s)
        right = np.minimum(box[2], u + (box[2] - u) / s)
        width = right - left
        valid = (s > 0) & (s <= 1 + 1e-12) & (width > 0) & (width < np.inf)
        valid &= (cc >= 0) & (cc <= 1) & (v < y0) & (y0 < y1) & (y1 < np.inf)
    # x of the rectangle's sides; "far" is what lies nearer to VPU.
    towards_left = u < (box[0] + box[2]) / 2
    hidden, visible = np.where(towards_left, right, left), np.where(towards_left, left, right)
    hidden_far, visible_far = u + s * (hidden - u), u + s * (visible - u)
    y1_far = flip * (v + s * (y1 - v))
    c, y0, y1 = flip * c, flip * y0, flip * y1

    # VPU above: the rectangle is the front face. VPU below: it is the roof, whose rear edge is y1.
    vertices = np.empty((len(cc), 8, 2))
    vertices[:, 0, 0], vertices[:, 1, 0] = hidden, visible
    vertices[:, 0, 1] = vertices[:, 1, 1] = c
    vertices[:, 2, 0], vertices[:, 3, 0] = (
        np.where(below, visible, visible_far),
        np.where(below, hidden, hidden_far),
    )
    vertices[:, 2, 1] = vertices[:, 3, 1] = np.where(below, y1, y0)
    vertices[:, 4, 0], vertices[:, 5, 0] = (
        np.where(below, hidden_far, hidden),
        np.where(below, visible_far, visible),
    )
    vertices[:, 4, 1] = vertices[:, 5, 1] = np.where(below, y0, y1)
    vertices[:, 6, 0], vertices[:, 7, 0] = visible_far, hidden_far
    vertices[:, 6, 1] = vertices[:, 7, 1] = y1_far
    return vertices, valid


def reorder_vertices(vertices: Array, mirrored: ArrayLike, backwards: ArrayLike) -> Array:
    """Return decoded vertices in the order of the boxes that were encoded, or the other way round.

    Args:
        vertices: (N, 8, 2).
        mirrored: (N,) bool, as in `EncodedBoxes`.
        backwards: (N,) bool, `EncodedBoxes.reversed`.

    Returns:
        (N, 8, 2), the same points in another order.
    """
    order = np.asarray(mirrored, dtype=np.int64) + 2 * np.asarray(backwards, dtype=np.int64)
    out: Array = np.take_along_axis(vertices, _VERTEX_ORDERS[order][..., None], axis=1)
    return out


def front_bottom_midpoints(vertices: Array) -> Array:
    """Return the middle (N, 2) of each box's bottom front edge, its contact point, from vertices (N, 8, 2).

    Source: Kocur & Ftacnik 2020, section 3.5.
    """
    out: Array = vertices[:, 4:6].mean(axis=1)
    return out
