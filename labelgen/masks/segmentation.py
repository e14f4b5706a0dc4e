"""COCO segmentations to crops: RLE, compressed or not, and polygons. Only the mask's own box is ever filled.

RLE is decoded here and not by pycocotools, which trusts the run lengths that a file gives.
Source of the run-length text: pycocotools, `rleFrString`; of what a polygon covers: pycocotools, `rleFrPoly`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle_tools

from labelgen.masks.instances import crop_mask

__all__ = ["decode_segmentation"]

Crop = tuple[tuple[int, int], NDArray[np.bool_]]


def decode_segmentation(segmentation: Any, frame_wh: tuple[int, int]) -> Crop:
    """A COCO segmentation as origin px (x, y) and crop (h, w) bool.

    Raises:
        ValueError: what is wrong with it, as the end of a sentence about the annotation.
    """
    if isinstance(segmentation, dict):
        part = _decode_rle(segmentation, frame_wh)
    elif isinstance(segmentation, list) and segmentation:
        part = _decode_polygons(segmentation, frame_wh)
    else:
        raise ValueError("it has no segmentation")
    if part is None:
        raise ValueError("its mask is empty or outside the frame")
    return part


def _decode_rle(rle: dict[str, Any], frame_wh: tuple[int, int]) -> Crop | None:
    w, h = frame_wh
    size, counts = rle.get("size"), rle.get("counts")
    if size != [h, w]:
        raise ValueError(f"its RLE is for a frame of size (height, width) {size}, not {[h, w]}")
    if isinstance(counts, str):
        counts = _parse_counts(counts)
    if not isinstance(counts, list) or not all(isinstance(c, int) and 0 <= c <= w * h for c in counts):
        raise ValueError("its RLE has no usable counts")
    ends = np.cumsum(np.array(counts, dtype=np.int64))
    if ends.size == 0 or ends[-1] != w * h:
        raise ValueError(f"its RLE covers {int(ends[-1]) if ends.size else 0} of {w * h} pixels")
    # Runs go down the columns, unset and set in turn; fill only the columns between the first and last set run.
    set_runs = np.flatnonzero(np.diff(ends, prepend=0)[1::2]) * 2 + 1
    if set_runs.size == 0:
        return None
    first, last = int(ends[set_runs[0] - 1]) // h, -(-int(ends[set_runs[-1]]) // h)
    clipped = np.clip(ends, first * h, last * h)
    lengths = clipped - np.concatenate([[first * h], clipped[:-1]])
    slab = np.repeat(np.arange(lengths.size) % 2 == 1, lengths).reshape(last - first, h).T
    return crop_mask(slab, (first, 0))


def _parse_counts(text: str) -> list[int]:
    """Run lengths from COCO's text: 5 bits a character, little end first, differences to the last but one run."""
    counts: list[int] = []
    value = shift = 0
    for code in text.encode("utf-8", "replace"):
        bits = code - 48
        if not 0 <= bits < 64:
            raise ValueError("its RLE holds characters that are no run lengths")
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            if shift > 60:
                raise ValueError("its RLE holds a run length beyond any frame")
            continue
        if bits & 0x10:
            value -= 1 << shift
        counts.append(value + (counts[-2] if len(counts) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("its RLE is cut off")
    return counts


def _decode_polygons(polygons: list[Any], frame_wh: tuple[int, int]) -> Crop | None:
    w, h = frame_wh
    points = []
    for polygon in polygons:
        if not isinstance(polygon, list) or len(polygon) < 6 or len(polygon) % 2:
            raise ValueError("its polygon is not a list of at least three x, y pairs")
        if not all(isinstance(v, int | float) and math.isfinite(v) and abs(v) <= 4 * max(w, h) for v in polygon):
            raise ValueError("its polygon has coordinates that are no numbers or far outside the frame")
        points.append(np.array(polygon, dtype=np.float64).reshape(-1, 2))
    low = np.clip(np.floor(np.min([p.min(axis=0) for p in points], axis=0)), 0, frame_wh).astype(int)
    high = np.clip(np.ceil(np.max([p.max(axis=0) for p in points], axis=0)), 0, frame_wh).astype(int)
    if (high <= low).any():
        return None
    size = high - low
    rles = rle_tools.frPyObjects([(p - low).ravel().tolist() for p in points], int(size[1]), int(size[0]))
    return crop_mask(rle_tools.decode(rle_tools.merge(rles)), (int(low[0]), int(low[1])))
