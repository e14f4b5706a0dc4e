"""Pictures of what a detector found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detector.metrics import Found
from labelgen.drawing import GREEN, YELLOW, Picture, draw_box3d, draw_polyline, draw_text
from labelgen.geometry import decode_boxes
from labelgen.geometry.homography import Array
from labelgen.labels import Sample

__all__ = ["draw_boxes", "draw_found", "tile"]


def draw_found(sample: Sample, found: Found, score: float = 0.5) -> Picture:
    """A sample's picture with its labels' boxes in green and the detections' 3D boxes, or 2D boxes where invalid."""
    image = sample.image
    for box in sample.labels.boxes_xyxy:
        _draw_box(image, box, GREEN)
    draw_boxes(image, found[found.scores >= score], sample.rectification.vpu)
    return image


def draw_boxes(image: Picture, found: Found, vpu: Array) -> None:
    vertices, valid = decode_boxes(found.boxes_xyxy, found.cc, vpu)
    for box, corners, good, value in zip(found.boxes_xyxy, vertices, valid, found.scores, strict=True):
        if good:
            draw_box3d(image, corners)
        else:
            _draw_box(image, box, YELLOW)
        draw_text(image, f"{value:.2f}", (int(box[0]), max(10, int(box[1]) - 2)), 0.35)


def _draw_box(image: Picture, box: Array, colour: tuple[int, int, int]) -> None:
    draw_polyline(image, box[[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2), colour, closed=True)


def tile(pictures: Sequence[Picture], columns: int = 4) -> Picture:
    """Pictures of one size in rows."""
    rows = [list(pictures[i : i + columns]) for i in range(0, len(pictures), columns)]
    width = min(columns, len(pictures))
    blank = np.zeros_like(pictures[0])
    return np.asarray(np.vstack([np.hstack(row + [blank] * (width - len(row))) for row in rows]), dtype=np.uint8)
