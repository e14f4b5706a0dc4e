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

from labelgen.geometry.frame_size import scale_between
from labelgen.masks.coco_file import whole_number
from labelgen.masks.instances import Crop, crop_mask

__all__ = ["SegmentationError", "check_segmentation", "decode_segmentation"]

# Characters of a run length in COCO's text, 5 bits each: 40 bits count the pixels of any frame.
_MAX_RUN_CHARACTERS = 8
# Largest image that a mask may be scaled from: more than any camera's, and little memory.
_MAX_PIXELS = 1 << 27
_EMPTY = "its mask is empty or outside the frame"


class SegmentationError(ValueError):
    """A segmentation that gives no mask.

    Args:
        message: what is wrong; it continues a sentence about the annotation.
        kind: what is wrong, the same for all segmentations of a kind.
        drawn_wh: size of the frames that it is of, px, where that is another size; otherwise None.
    """

    def __init__(self, message: str, kind: str = "", drawn_wh: tuple[int, int] | None = None) -> None:
        super().__init__(message)
        self.kind, self.drawn_wh = kind or message, drawn_wh


def check_segmentation(
    segmentation: Any, frame_wh: tuple[int, int], *, drawn_wh: tuple[int, int] | None = None, scale: bool = False
) -> None:
    """Check a COCO segmentation, without filling a mask where it is of the frame's size.

    Args:
        segmentation, frame_wh, drawn_wh, scale: see `decode_segmentation`.

    Raises:
        SegmentationError: `decode_segmentation` would raise it.
    """
    own = _own_size(segmentation, frame_wh, drawn_wh)
    if own != frame_wh and isinstance(segmentation, dict):
        decode_segmentation(segmentation, frame_wh, drawn_wh=drawn_wh, scale=scale)
    else:
        _read(segmentation, frame_wh, own, scale)


def decode_segmentation(
    segmentation: Any, frame_wh: tuple[int, int], *, drawn_wh: tuple[int, int] | None = None, scale: bool = False
) -> Crop:
    """Decode a COCO segmentation.

    Args:
        segmentation: `segmentation` of a COCO annotation.
        frame_wh: size of the frame, px.
        drawn_wh: size of the image that polygons are of, px, where the file announces one; RLE states its own.
        scale: whether a segmentation of an image of another size and the same ratio is scaled.

    Returns:
        Origin (x, y) of the crop in the frame, px, and the crop (h, w) bool.

    Raises:
        SegmentationError: the segmentation is unusable; the message continues a sentence about the annotation.
    """
    own = _own_size(segmentation, frame_wh, drawn_wh)
    runs = _read(segmentation, frame_wh, own, scale)
    if not isinstance(runs, np.ndarray):
        crop = _fill_polygon(*runs)
        assert crop is not None  # `_read` has checked that the area is not 0
        return crop
    crop = _fill_columns(runs, own[1])
    assert crop is not None  # likewise
    if own != frame_wh:
        crop = _scale_crop(crop, own, frame_wh)
        if crop is None:
            raise SegmentationError(_EMPTY)
    return crop


def _own_size(segmentation: Any, frame_wh: tuple[int, int], drawn_wh: tuple[int, int] | None) -> tuple[int, int]:
    """Return the size of the image that a segmentation is of; the frame's where it states none."""
    if not isinstance(segmentation, dict):
        return drawn_wh or frame_wh
    size = segmentation.get("size")
    sides = [whole_number(value) for value in size] if isinstance(size, list | tuple) else []
    if len(sides) != 2 or not all(side and side > 0 for side in sides):
        raise SegmentationError(
            f"its RLE is for a frame of size (height, width) {str(size)[:40]}, not {[frame_wh[1], frame_wh[0]]}",
            "its RLE has no size",
        )
    return int(sides[1] or 0), int(sides[0] or 0)


def _read(
    segmentation: Any, frame_wh: tuple[int, int], own_wh: tuple[int, int], scale: bool
) -> NDArray[np.int64] | tuple[dict[str, Any], tuple[int, int]]:
    """Return the ends of the runs of an RLE; for polygons, their RLE within their bounding box and its origin."""
    is_rle = isinstance(segmentation, dict)
    if not is_rle and not (isinstance(segmentation, list) and segmentation):
        raise SegmentationError("it has no segmentation")
    if own_wh != frame_wh and not (scale and scale_between(own_wh, frame_wh) and np.prod(own_wh) <= _MAX_PIXELS):
        what = "RLE is for a frame of" if is_rle else "polygons are drawn on a frame of"
        raise SegmentationError(
            f"its {what} size (height, width) {[own_wh[1], own_wh[0]]}, not {[frame_wh[1], frame_wh[0]]}",
            drawn_wh=own_wh,
        )
    if is_rle:
        return _run_ends(segmentation, own_wh)
    factors = (frame_wh[0] / own_wh[0], frame_wh[1] / own_wh[1])
    return _polygons_to_rle(segmentation, frame_wh, factors)


def _run_ends(rle: dict[str, Any], frame_wh: tuple[int, int]) -> NDArray[np.int64]:
    """Return (R,) the pixel at which each run ends, counted down the columns; unset and set runs alternate."""
    w, h = frame_wh
    counts = rle.get("counts")
    if isinstance(counts, str):
        lengths = _parse_counts(counts)
    elif isinstance(counts, list) and all(isinstance(c, int) and 0 <= c <= w * h for c in counts):
        lengths = np.array(counts, dtype=np.int64)
    else:
        raise SegmentationError("its RLE has no usable counts")
    if ((lengths < 0) | (lengths > w * h)).any():
        raise SegmentationError("its RLE has no usable counts")
    ends = np.cumsum(lengths)
    if ends.size == 0 or ends[-1] != w * h:
        covered = int(ends[-1]) if ends.size else 0
        raise SegmentationError(f"its RLE covers {covered} of {w * h} pixels", "its RLE does not cover the frame")
    if not lengths[1::2].any():
        raise SegmentationError(_EMPTY)
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
        raise SegmentationError("its RLE holds characters that are no run lengths")
    if bits.size == 0:
        return bits
    ends = np.flatnonzero(bits < 32)
    starts = np.concatenate([[0], ends + 1])
    sizes = np.diff(np.append(starts, bits.size))
    if sizes.max() > _MAX_RUN_CHARACTERS:
        raise SegmentationError("its RLE holds a run length beyond any frame")
    if sizes[-1]:
        raise SegmentationError("its RLE is cut off")
    starts, sizes = starts[:-1], sizes[:-1]
    place = np.arange(bits.size) - np.repeat(starts, sizes)
    counts = np.add.reduceat((bits & 31) << (5 * place), starts)
    counts -= np.where(bits[ends] & 16, 1 << (5 * sizes), 0)
    # The first three are absolute.
    counts[1::2] = np.cumsum(counts[1::2])
    counts[2::2] = np.cumsum(counts[2::2])
    return counts


def _polygons_to_rle(
    polygons: list[Any], frame_wh: tuple[int, int], factors: tuple[float, float] = (1.0, 1.0)
) -> tuple[dict[str, Any], tuple[int, int]]:
    farthest = 4 * max(frame_wh) / min(factors)
    points = []
    for polygon in polygons:
        if not isinstance(polygon, list) or len(polygon) < 6 or len(polygon) % 2:
            raise SegmentationError("its polygon is not a list of at least three x, y pairs")
        if not all(isinstance(v, int | float) and abs(v) <= farthest for v in polygon):
            raise SegmentationError("its polygon has coordinates that are no numbers or far outside the frame")
        points.append(np.array(polygon, dtype=np.float64).reshape(-1, 2) * factors)
    low = np.clip(np.floor(np.min([p.min(axis=0) for p in points], axis=0)), 0, frame_wh).astype(int)
    high = np.clip(np.ceil(np.max([p.max(axis=0) for p in points], axis=0)), 0, frame_wh).astype(int)
    if (high <= low).any():
        raise SegmentationError(_EMPTY)
    size = high - low
    parts = rle_tools.frPyObjects([(p - low).ravel().tolist() for p in points], int(size[1]), int(size[0]))
    rle: dict[str, Any] = rle_tools.merge(parts)
    if not rle_tools.area(rle):
        raise SegmentationError(_EMPTY)
    return rle, (int(low[0]), int(low[1]))


def _fill_polygon(rle: dict[str, Any], origin_px: tuple[int, int]) -> Crop | None:
    return crop_mask(rle_tools.decode(rle), origin_px)


def _scale_crop(crop: Crop, own_wh: tuple[int, int], frame_wh: tuple[int, int]) -> Crop | None:
    """Resample a crop to frames of another size: pixels are set that are covered to half."""
    (x, y), mask = crop
    fx, fy = frame_wh[0] / own_wh[0], frame_wh[1] / own_wh[1]
    low = (int(x * fx), int(y * fy))
    high = (
        min(frame_wh[0], int(np.ceil((x + mask.shape[1]) * fx))),
        min(frame_wh[1], int(np.ceil((y + mask.shape[0]) * fy))),
    )
    # The area of any rectangle follows from the cumulative sums at its corners.
    sums = np.pad(mask, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1).astype(np.float64)
    sums = _sample_rows(sums, np.arange(low[1], high[1] + 1) / fy - y)
    sums = _sample_rows(sums.T, np.arange(low[0], high[0] + 1) / fx - x).T
    covered = np.diff(np.diff(sums, axis=0), axis=1) * (fx * fy)
    return crop_mask(covered >= 0.5 - 1e-9, low)


def _sample_rows(values: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rows of an array at fractional positions, linear between two rows."""
    at = np.clip(at, 0, len(values) - 1)
    first = np.minimum(at.astype(np.int64), len(values) - 2)
    share = (at - first)[:, None]
    return np.asarray(values[first] * (1 - share) + values[first + 1] * share)
