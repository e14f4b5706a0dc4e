"""Masks of candidates at the frame's resolution: interpolated before they are thresholded, one for each vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.instances import Crop, crop_mask
from labelgen.masks.onnx.candidates import Candidates
from labelgen.masks.onnx.placement import Placement

__all__ = ["CROP_SETTINGS", "CropSettings", "candidate_crops", "drop_doubles"]

# Masks computed at once: bounds the memory.
_CHUNK = 16


@dataclass(frozen=True)
class CropSettings:
    """How masks are cut."""

    margin_px: float = 2.0
    """A box cuts its mask only so far outside, px of the network's picture: boxes often end a pixel or two short."""
    margin_share: float = 0.02
    """The same, as a share of the box's longer side; the larger of the two counts."""
    max_gap_share: float = 0.1
    """A part further from the largest part, as a share of the box's longer side, belongs to something else."""
    max_double_iou: float = 0.5
    """Masks that overlap by more are of one vehicle."""
    max_inside_share: float = 0.8
    """A mask that lies inside another to a greater share is of the same vehicle."""


CROP_SETTINGS = CropSettings()


def candidate_crops(
    candidates: Candidates,
    chosen: NDArray[np.int64],
    placement: Placement,
    settings: CropSettings = CROP_SETTINGS,
) -> list[Crop | None]:
    """Return the masks of chosen candidates in the frame; None for those without a pixel.

    Args:
        candidates: of one picture.
        chosen: (K,) their indices.
        placement: where the picture lies in the frame.
        settings: how masks are cut.
    """
    out: list[Crop | None] = []
    for start in range(0, len(chosen), _CHUNK):
        some = chosen[start : start + _CHUNK]
        boxes = candidates.boxes_xyxy[some].astype(np.float64)
        for box, logits in zip(boxes, candidates.mask_logits(some), strict=True):
            spanned = box if candidates.fill_box else np.array([0.0, 0.0, *placement.picture_wh])
            out.append(_crop(logits, spanned, box, placement, settings))
    return out


def _crop(
    logits: NDArray[np.float32],
    spanned: NDArray[np.float64],
    box: NDArray[np.float64],
    placement: Placement,
    settings: CropSettings,
) -> Crop | None:
    """Return one mask in the frame.

    Args:
        logits: (h, w), above 0 inside.
        spanned: (4,) part of the picture that they span, px.
        box: (4,) the candidate's, px of the picture.
        placement: where the picture lies in the frame.
        settings: how masks are cut.
    """
    longer = float((box[2:] - box[:2]).max())
    # Nothing is known of what lies outside a grid.
    margin = 0.0 if spanned is box else max(settings.margin_px, settings.margin_share * longer)
    enlarged = placement.boxes_to_frame(box + np.array([-margin, -margin, margin, margin]))[0]
    window = placement.window
    # A pixel belongs to the box if its centre does.
    low = np.maximum(np.ceil(enlarged[:2] - 0.5), window[:2]).astype(np.int64)
    high = np.minimum(np.floor(enlarged[2:] - 0.5) + 1, window[2:]).astype(np.int64)
    if (low >= high).any():
        return None
    cells = np.array(logits.shape[::-1]) / (spanned[2:] - spanned[:2])
    x, y = (
        ((np.arange(low[k], high[k]) + 0.5) * placement.scale[k] + placement.offset[k] - spanned[k]) * cells[k] - 0.5
        for k in (0, 1)
    )
    mask = _interpolate(logits, x, y) > 0
    cropped = crop_mask(mask, (int(low[0]), int(low[1])))
    if cropped is None:
        return None
    max_gap = settings.max_gap_share * longer / float(placement.scale.min())
    return crop_mask(_drop_far_parts(cropped[1], max_gap), cropped[0])


def _interpolate(grid: NDArray[np.float32], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return a grid (h, w), interpolated linearly at columns x (W,) and rows y (H,); constant beyond its border.

    OpenCV's warp knows 32 steps from cell to cell, and a cell may be as wide as many pixels of the frame.
    """
    rows, row_weights = _neighbours(y, grid.shape[0])
    columns, column_weights = _neighbours(x, grid.shape[1])
    part = grid[rows.min() : rows.max() + 2, columns.min() : columns.max() + 2]
    rows, columns = rows - rows.min(), columns - columns.min()
    low, high = (np.minimum(rows + k, len(part) - 1) for k in (0, 1))
    tall = part[low] + row_weights[:, None] * (part[high] - part[low])
    low, high = (np.minimum(columns + k, part.shape[1] - 1) for k in (0, 1))
    left = tall[:, low]
    return np.asarray(left + column_weights * (tall[:, high] - left), dtype=np.float32)


def _neighbours(positions: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the cell before each position, and how far the position is from it to the next."""
    inside = np.clip(positions, 0, count - 1)
    before = np.floor(inside).astype(np.int64)
    return before, (inside - before).astype(np.float32)


def _drop_far_parts(mask: NDArray[np.bool_], max_gap: float) -> NDArray[np.bool_]:
    """Return a mask without parts that lie far from its largest one."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    if count < 3:
        return mask
    low = stats[1:, : cv2.CC_STAT_TOP + 1]
    high = low + stats[1:, cv2.CC_STAT_WIDTH : cv2.CC_STAT_HEIGHT + 1]
    largest = int(stats[1:, cv2.CC_STAT_AREA].argmax())
    gaps = np.maximum(np.maximum(low - high[largest], low[largest] - high), 0).max(axis=1)
    near = np.concatenate([[False], gaps <= max_gap])
    return np.asarray(near[labels])


def drop_doubles(crops: list[Crop], settings: CropSettings = CROP_SETTINGS) -> list[int]:
    """Return which masks remain when each vehicle is to have one.

    Of masks that cover the same pixels the first remains. Of a mask inside another one, the larger remains, as networks
    find parts of lorries; but a mask around several vehicles goes.

    Args:
        crops: best first.
        settings: how much two masks of one vehicle overlap.
    """
    areas = [int(np.count_nonzero(crop)) for _, crop in crops]
    shared = _shared_pixels(crops)
    kept: list[int] = []
    for i in range(len(crops)):
        overlaps = ((shared.get((j, i), 0), areas[i] + areas[j]) for j in kept)
        if all(both <= settings.max_double_iou * (total - both) for both, total in overlaps):
            kept.append(i)
    parts: dict[int, list[int]] = {}
    for (a, b), both in shared.items():
        outer, inner = (a, b) if areas[a] >= areas[b] else (b, a)
        if {a, b} <= set(kept) and both > settings.max_inside_share * areas[inner]:
            parts.setdefault(outer, []).append(inner)
    gone: set[int] = set()
    for outer, inners in parts.items():
        several = len(inners) > 1 and sum(areas[i] for i in inners) > settings.max_double_iou * areas[outer]
        gone.update([outer] if several else inners)
    return [i for i in kept if i not in gone]


def _shared_pixels(crops: list[Crop]) -> dict[tuple[int, int], int]:
    """Return how many pixels each two masks share, first index below second, where any."""
    n = len(crops)
    low = np.array([origin for origin, _ in crops], dtype=np.int64).reshape(-1, 2)
    high = low + np.array([crop.shape[::-1] for _, crop in crops], dtype=np.int64).reshape(-1, 2)
    overlap = (low[:, None] < high[None]).all(-1) & (low[None] < high[:, None]).all(-1)
    out = {}
    for a, b in np.argwhere(np.triu(overlap, 1)).tolist() if n else ():
        x0, y0 = np.maximum(low[a], low[b]).tolist()
        x1, y1 = np.minimum(high[a], high[b]).tolist()
        first, second = (crops[i][1][y0 - low[i, 1] : y1 - low[i, 1], x0 - low[i, 0] : x1 - low[i, 0]] for i in (a, b))
        if count := int(np.count_nonzero(first & second)):
            out[a, b] = count
    return out
