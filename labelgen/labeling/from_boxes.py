"""Labels from 3D boxes of rectified crops, with a reason for every box that gives none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labelgen.geometry.box_codec import decode_boxes, encode_boxes, reorder_vertices
from labelgen.geometry.homography import Array
from labelgen.labels import Flag, Labels, VehicleClass

__all__ = ["BOX_LIMITS", "BoxLimits", "label_boxes"]


@dataclass(frozen=True)
class BoxLimits:
    """Thresholds for labels from annotated 3D boxes."""

    max_aligned_error: float = 0.02
    """Largest distance of a decoded vertex from the annotated one, as a share of the 2D box's larger side, that is not
    flagged as misaligned. Less flags boxes that differ by the rounding of their annotation."""
    max_error: float = 0.25
    """Largest such distance that gives a label at all: beyond it the label shows another box than the annotation."""
    min_cc_margin: float = 1e-3
    """Least distance of c_c from 0 and 1: nearer, the box has no depth or no height."""
    min_inside: float = 0.5
    """Least share of the 2D box inside the image: with less, the annotation belongs to another image or camera."""


BOX_LIMITS = BoxLimits()


def label_boxes(
    vertices: Array, vpus: Array, size_wh: tuple[int, int], limits: BoxLimits = BOX_LIMITS
) -> list[Labels | tuple[str, str]]:
    """Label N rectified images that show one 3D box each.

    Args:
        vertices: (N, 8, 2) rectified px, in the order of `labelgen.geometry.box_codec`.
        vpus: (N, 2) rectified px, the finite vanishing point of each image.
        size_wh: size of the rectified images, px.
        limits: thresholds.

    Returns:
        For each box its one label, or the reason and the detail why there is none.
    """
    finite = np.asarray(np.isfinite(vertices).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], vertices, 0.0)
    encoded = encode_boxes(safe, vpus)
    # Shards store float32, so the label is what can be decoded from float32.
    boxes = encoded.boxes_xyxy.astype(np.float32).astype(np.float64)
    cc = encoded.cc.astype(np.float32).astype(np.float64)
    decoded, valid = decode_boxes(boxes, cc, vpus)
    valid &= (cc > limits.min_cc_margin) & (cc < 1 - limits.min_cc_margin)
    decoded = reorder_vertices(decoded, encoded.mirrored, encoded.reversed)
    extent = np.maximum((boxes[:, 2:] - boxes[:, :2]).max(axis=1), 1e-9)
    with np.errstate(invalid="ignore"):
        error = np.asarray(np.abs(decoded - safe).max(axis=(1, 2)) / extent)
    outside = (boxes[:, :2] < -0.5).any(axis=1) | (boxes[:, 2:] > np.asarray(size_wh) + 0.5).any(axis=1)
    low, high = np.clip(boxes[:, :2], 0, size_wh), np.clip(boxes[:, 2:], 0, size_wh)
    area = np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1e-9)
    inside = (high - low).prod(axis=1) / area
    flags = (
        Flag.MIRRORED * encoded.mirrored
        + Flag.REVERSED * encoded.reversed
        + Flag.MISALIGNED * (error > limits.max_aligned_error)
        + Flag.TRUNCATED * outside
    )
    good = finite & valid & (error <= limits.max_error) & (inside >= limits.min_inside)
    labels = Labels(boxes[good], cc[good], np.full(good.sum(), VehicleClass.VEHICLE), flags=flags[good])
    row = np.cumsum(good) - 1
    results: list[Labels | tuple[str, str]] = []
    for i in range(len(vertices)):
        if good[i]:
            results.append(labels[row[i] : row[i] + 1])
        elif not finite[i]:
            results.append(("box beyond the horizon", "a corner of its 3D box lies on or beyond the horizon"))
        elif not valid[i]:
            detail = f"c_c {cc[i]:.3f} in a box of {extent[i]:.1f} px decodes to no 3D box"
            results.append(("no valid 3D box", detail))
        elif inside[i] < limits.min_inside:
            detail = f"{inside[i]:.0%} of its box lies in the picture; check 3DBB_offset and camera"
            results.append(("outside the picture", detail))
        else:
            detail = f"decoded, it lies {error[i]:.0%} of its size from the annotated one"
            results.append(("box against the vanishing points", detail))
    return results
