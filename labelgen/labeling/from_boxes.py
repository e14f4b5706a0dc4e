"""Labels from 3D boxes of rectified crops, with a reason for every box that gives none."""

from __future__ import annotations

import numpy as np

from labelgen.geometry.box_codec import decode_boxes, encode_boxes, reorder_vertices
from labelgen.geometry.homography import Array
from labelgen.labels import Flag, Labels, VehicleClass

__all__ = ["label_boxes"]


# A decoded box further than this share of its size from the annotated one is flagged as misaligned.
_MISALIGNED = 0.02


# ... and beyond this one the label would show another box than the annotation: it is refused.
_UNUSABLE = 0.25


# c_c this close to 0 or 1 is a box without depth or without height: no vehicle.
_FLAT = 1e-3


# A label with less than this share of its box inside the picture is of something else than the picture shows.
_INSIDE = 0.5


def label_boxes(vertices: Array, vpus: Array, size_wh: tuple[int, int]) -> list[Labels | tuple[str, str]]:
    """For each rectified box (N, 8, 2) its label, or the reason and detail why there is none."""
    finite = np.asarray(np.isfinite(vertices).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], vertices, 0.0)
    encoded = encode_boxes(safe, vpus)
    # What is stored is float32: what cannot be decoded from that is no label.
    boxes = encoded.boxes_xyxy.astype(np.float32).astype(np.float64)
    cc = encoded.cc.astype(np.float32).astype(np.float64)
    decoded, valid = decode_boxes(boxes, cc, vpus)
    valid &= (cc > _FLAT) & (cc < 1 - _FLAT)
    decoded = reorder_vertices(decoded, encoded.mirrored, encoded.reversed)
    extent = np.maximum((boxes[:, 2:] - boxes[:, :2]).max(axis=1), 1e-9)
    with np.errstate(invalid="ignore"):
        off = np.asarray(np.abs(decoded - safe).max(axis=(1, 2)) / extent)
    outside = (boxes[:, :2] < -0.5).any(axis=1) | (boxes[:, 2:] > np.asarray(size_wh) + 0.5).any(axis=1)
    low, high = np.clip(boxes[:, :2], 0, size_wh), np.clip(boxes[:, 2:], 0, size_wh)
    area = np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1e-9)
    inside = (high - low).prod(axis=1) / area
    flags = (
        Flag.MIRRORED * encoded.mirrored
        + Flag.REVERSED * encoded.reversed
        + Flag.MISALIGNED * (off > _MISALIGNED)
        + Flag.TRUNCATED * outside
    )
    good = finite & valid & (off <= _UNUSABLE) & (inside >= _INSIDE)
    labels = Labels(boxes[good], cc[good], np.full(good.sum(), VehicleClass.VEHICLE), flags=flags[good])
    row = np.cumsum(good) - 1
    found: list[Labels | tuple[str, str]] = []
    for i in range(len(vertices)):
        if good[i]:
            found.append(labels[row[i] : row[i] + 1])
        elif not finite[i]:
            found.append(("box beyond the horizon", "a corner of its 3D box lies on or beyond the horizon"))
        elif not valid[i]:
            detail = f"c_c {cc[i]:.3f} in a box of {extent[i]:.1f} px decodes to no 3D box"
            found.append(("no valid 3D box", detail))
        elif inside[i] < _INSIDE:
            detail = f"{inside[i]:.0%} of its box lies in the picture; check 3DBB_offset and camera"
            found.append(("outside the picture", detail))
        else:
            detail = f"decoded, it lies {off[i]:.0%} of its size from the annotated one"
            found.append(("box against the vanishing points", detail))
    return found
