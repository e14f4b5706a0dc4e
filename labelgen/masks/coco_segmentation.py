"""Decode COCO segmentations to crops: polygons and run-length encoding (RLE), compressed or not.

Only the mask's bounding box is filled, not the whole frame. RLE is decoded here and not by pycocotools, which does not
check the run lengths of a file.

Source: pycocotools, `rleFrString` (text form of run lengths) and `rleFrPoly` (pixels of a polygon).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle_tools

from labelgen.masks.instances import Crop, crop_mask

__all__ = ["check_segmentation", "decode_segmentation"]

# Characters of a run length in COCO's text, 5 bits each: 40 bits count the pixels of any frame.
_MAX_RUN_CHARACTERS = 8
_EMPTY = "its mask is empty or outside the frame"


def check_segmentation(segmentation: Any, frame_wh: tuple[int, int]) -> None:
    """Check a COCO segmentation without filling a mask.

    Args:
        segmentation: `segmentation` of a COCO annotation.
        frame_wh: size of the frame, px.

    Raises:
        ValueError: `decode_segmentation` would raise it.
    """
    _read(segmentation, frame_wh)


def decode_segmentation(segmentation: Any, frame_wh: tuple[int, int]) -> Crop:
    """Decode a COCO segmentation.

    Args:
        segmentation: `segmentation` of a COCO annotation.
        frame_wh: size of the frame, px.

    Returns:
        Origin (x, y) of the crop in the frame, px, and the crop (h, w) bool.

    Raises:
        ValueError: the segmentation is unusable; the message continues a sentence about the annotation.
    """
    runs = _read(segmentation, frame_wh)
    crop = _fill_columns(runs, frame_wh[1]) if isinstance(runs, np.ndarray) else _fill_polygon(*runs)
    assert crop is not None  # `_read` has checked that the area is not 0
    return crop


def _read(segmentation: Any, frame_wh: tuple[int, int]) -> NDArray[np.int64] | tuple[dict[str, Any], tuple[int, int]]:
    """Return the ends of the runs of an RLE; for polygons, their RLE within their bounding box and its origin."""
    if isinstance(segmentation, dict):
        return _run_ends(segmentation, frame_wh)
    if isinstance(segmentation, list) and segmentation:
        return _polygons_to_rle(segmentation, frame_wh)
    raise ValueError("it has no segmentation")


def _run_ends(rle: dict[str, Any], frame_wh: tuple[int, int]) -> NDArray[np.int64]:
    """Return (R,) the pixel at which each run ends, counted down the columns; unset and set runs alternate."""
    w, h = frame_wh
    size, counts = rle.get("size"), rle.get("counts")
    if size != [h, w]:
        raise ValueError(f"its RLE is for a frame of size (height, width) {str(size)[:40]}, not {[h, w]}")
    if isinstance(counts, str):
        lengths = _parse_counts(counts)
    elif isinstance(counts, list) and all(isinstance(c, int) and 0 <= c <= w * h for c in counts):
        lengths = np.array(counts, dtype=np.int64)
    else:
        raise ValueError("its RLE has no usable counts")
    if ((lengths < 0) | (lengths > w * h)).any():
        raise ValueError("its RLE has no usable counts")
    ends = np.cumsum(lengths)
    if ends.size == 0 or ends[-1] != w * h:
        raise ValueError(f"its RLE covers {int(ends[-1]) if ends.size else 0} of {w * h} pixels")
    if not lengths[1::2].any():
        raise ValueError(_EMPTY)
    return ends


def _fill_columns(ends: NDArray[np.int64], h: int) -> Crop | None:
    """Fill the columns between the first and the last set run."""
    set_runs = np.flatnonzero(np.diff(ends, prepend=0)[1::2]) * 2 + 1
    first, last = int(ends[set_runs[0] - 1]) // h, -(-int(ends[set_runs[-1]]) // h)
    clipped = np.clip(ends, first * h, last * h)
    lengths = clipped - np.concatenate([[first * h], clipped[:-1]])
    slab = np.repeat(np.arange(lengths.size) % 2 == 1, lengths).reshape(last - first, h).T
    return crop_mask(slab, (first, 0))


def _parse_counts(text: str) -> NDArray[np.int64]:
    """Parse (R,) run lengths from COCO's text.

    Each character holds 5 bits, the lowest first. From the fourth on, the numbers are differences to the run length two
    places before.
    """
    bits = np.frombuffer(text.encode("utf-8", "replace"), dtype=np.uint8).astype(np.int64) - 48
    if ((bits < 0) | (bits >= 64)).any():
        raise ValueError("its RLE holds characters that are no run lengths")
    if bits.size == 0:
        return bits
    ends = np.flatnonzero(bits < 32)
    starts = np.concatenate([[0], ends + 1])
    sizes = np.diff(np.append(starts, bits.size))
    if sizes.max() > _MAX_RUN_CHARACTERS:
        raise ValueError("its RLE holds a run length beyond any frame")
    if sizes[-1]:
        raise ValueError("its RLE is cut off")
    starts, sizes = starts[:-1], sizes[:-1]
    place = np.arange(bits.size) - np.repeat(starts, sizes)
    counts = np.add.reduceat((bits & 31) << (5 * place), starts)
    counts -= np.where(bits[ends] & 16, 1 << (5 * sizes), 0)
    # The first three are absolute.
    counts[1::2] = np.cumsum(counts[1::2])
    counts[2::2] = np.cumsum(counts[2::2])
    return counts


def _polygons_to_rle(polygons: list[Any], frame_wh: tuple[int, int]) -> tuple[dict[str, Any], tuple[int, int]]:
    farthest = 4 * max(frame_wh)
    points = []
    for polygon in polygons:
        if not isinstance(polygon, list) or len(polygon) < 6 or len(polygon) % 2:
            raise ValueError("its polygon is not a list of at least three x, y pairs")
        if not all(isinstance(v, int | float) and abs(v) <= farthest for v in polygon):
            raise ValueError("its polygon has coordinates that are no numbers or far outside the frame")
        points.append(np.array(polygon, dtype=np.float64).reshape(-1, 2))
    low = np.clip(np.floor(np.min([p.min(axis=0) for p in points], axis=0)), 0, frame_wh).astype(int)
    high = np.clip(np.ceil(np.max([p.max(axis=0) for p in points], axis=0)), 0, frame_wh).astype(int)
    if (high <= low).any():
        raise ValueError(_EMPTY)
    size = high - low
    parts = rle_tools.frPyObjects([(p - low).ravel().tolist() for p in points], int(size[1]), int(size[0]))
    rle: dict[str, Any] = rle_tools.merge(parts)
    if not rle_tools.area(rle):
        raise ValueError(_EMPTY)
    return rle, (int(low[0]), int(low[1]))


def _fill_polygon(rle: dict[str, Any], origin_px: tuple[int, int]) -> Crop | None:
    return crop_mask(rle_tools.decode(rle), origin_px)
