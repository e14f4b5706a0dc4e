"""Pictures with a detector's boxes in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from labelgen.drawing import GREEN, YELLOW, Picture, draw_box3d, draw_dashed_box, draw_polyline, draw_text
from labelgen.geometry import decode_boxes
from labelgen.geometry.homography import Array
from labelgen.labels import Labels, Sample

__all__ = ["draw_boxes", "draw_sample", "tile"]


def draw_sample(sample: Sample, detections: Labels, score: float = 0.5) -> Picture:
    """Draw a sample with the 2D boxes of its labels, in green, ignored boxes, dashed, and detections as `draw_boxes`.

    Args:
        sample: one rectified image with its labels.
        detections: in the sample's image, with scores.
        score: detections with a lower one are left out.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    image = sample.image
    for box in sample.labels.boxes_xyxy:
        _draw_box(image, box, GREEN)
    for box in sample.ignored.boxes_xyxy:
        draw_dashed_box(image, box)
    shown = detections[detections.scores >= score]
    draw_boxes(image, shown.boxes_xyxy, shown.cc, shown.scores, sample.rectification.vpu)
    return image


def draw_boxes(image: Picture, boxes_xyxy: Array, cc: Array, scores: NDArray[np.floating], vpu: Array) -> None:
    """Draw detections as 3D boxes, or as yellow 2D boxes where c_c gives no valid 3D box, with their scores.

    Args:
        image: (H, W, 3) uint8 BGR, rectified; is drawn into.
        boxes_xyxy: (N, 4) px.
        cc: (N,) in [0, 1], or NaN.
        scores: (N,) in [0, 1].
        vpu: (2,) px.
    """
    vertices, valid = decode_boxes(boxes_xyxy, cc, vpu)
    for box, corners, is_valid, score in zip(boxes_xyxy, vertices, valid, scores, strict=True):
        if is_valid:
            draw_box3d(image, corners)
        else:
            _draw_box(image, box, YELLOW)
        draw_text(image, f"{score:.2f}", (int(box[0]), max(10, int(box[1]) - 2)), 0.35)


def _draw_box(image: Picture, box: Array, color: tuple[int, int, int]) -> None:
    draw_polyline(image, box[[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2), color, closed=True)


def tile(pictures: Sequence[Picture], columns: int = 4) -> Picture:
    """Join pictures (H, W, 3) of one size in rows, black where the last row is not full."""
    rows = [list(pictures[i : i + columns]) for i in range(0, len(pictures), columns)]
    width = min(columns, len(pictures))
    blank = np.zeros_like(pictures[0])
    return np.asarray(np.vstack([np.hstack(row + [blank] * (width - len(row))) for row in rows]), dtype=np.uint8)
