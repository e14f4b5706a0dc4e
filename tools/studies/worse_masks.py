"""Masks made worse in the ways networks and background models do it, one at a time, by the same amounts for all."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks import InstanceMasks

__all__ = ["WORSE"]

Mask = NDArray[np.bool_]
_PAD = 24
_EDGE = 0.02
"""Share of a mask's size by which it is eroded or dilated."""
_BOX = 0.06
"""Largest share of a side that a box cuts off."""
_MIRROR = 0.09
"""Size of what is taken off as too thin, as a share of the mask's."""
_SHADOW = (0.02, 0.08)
"""Shares of a mask's height that a shadow is added below."""
_HIDDEN = 0.2
"""Share of the area that is hidden, from one side."""
_CELLS = 28
"""Cells across a mask of coarse ones."""


def _worse(change: Callable[[Mask, float, np.random.Generator], Mask]) -> Callable[[InstanceMasks, int], InstanceMasks]:
    def worsen(masks: InstanceMasks, seed: int) -> InstanceMasks:
        crops = []
        for number, (crop, (x, y)) in enumerate(zip(masks.crops, masks.origins.tolist(), strict=True)):
            rng = np.random.default_rng([seed, number, 11])
            wide, high = masks.frame_wh
            canvas = np.pad(crop, _PAD)
            changed = change(canvas, float(np.sqrt(crop.shape[0] * crop.shape[1])), rng)
            # What leaves the frame is cut off.
            left, top = max(0, _PAD - x), max(0, _PAD - y)
            changed = changed[top : high - y + _PAD, left : wide - x + _PAD]
            rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
            if not len(rows):
                continue
            inner = changed[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            origin = (x - _PAD + left + int(columns[0]), y - _PAD + top + int(rows[0]))
            crops.append((origin, inner))
        return InstanceMasks.from_crops(masks.frame_wh, crops, [0] * len(crops), [1.0] * len(crops))

    return worsen


def _disc(size: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1)), dtype=np.uint8)


def _morph(operation: int, share: float) -> Callable[[Mask, float, np.random.Generator], Mask]:
    def change(mask: Mask, size: float, rng: np.random.Generator) -> Mask:
        disc = _disc(min(_PAD - 1, max(1, round(share * size))))
        return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), operation, disc) > 0)

    return change


def _cut_by_box(mask: Mask, size: float, rng: np.random.Generator) -> Mask:
    out = mask.copy()
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    for lines, view in ((rows, out), (columns, out.T)):
        short = np.round(rng.uniform(0, _BOX, 2) * len(lines)).astype(int)
        view[: lines[0] + short[0]] = False
        view[lines[-1] + 1 - short[1] :] = False
    return out


def _with_shadow(mask: Mask, size: float, rng: np.random.Generator) -> Mask:
    high = int(mask.any(axis=1).sum())
    out = mask.copy()
    lowest = mask.shape[0] - 1 - np.argmax(mask[::-1], axis=0)
    lower = mask.any(axis=0) & (lowest > _PAD + 0.7 * high)
    for down in range(1, min(_PAD, max(1, round(rng.uniform(*_SHADOW) * high))) + 1):
        out[np.minimum(lowest[lower] + down, mask.shape[0] - 1), np.flatnonzero(lower)] = True
    return out


def _partly_hidden(mask: Mask, size: float, rng: np.random.Generator) -> Mask:
    out = mask.copy()
    view = [out, out[::-1], out.T, out.T[::-1]][int(rng.integers(4))]
    area = np.cumsum(view.sum(axis=1))
    view[: int(np.searchsorted(area, _HIDDEN * area[-1])) + 1] = False
    return out


def _coarse(mask: Mask, size: float, rng: np.random.Generator) -> Mask:
    cell = max(2.0, size / _CELLS)
    high, wide = mask.shape
    small = cv2.resize(
        mask.astype(np.float32), (max(2, round(wide / cell)), max(2, round(high / cell))), interpolation=cv2.INTER_AREA
    )
    return np.asarray(cv2.resize(small, (wide, high), interpolation=cv2.INTER_LINEAR) > 0.5)


WORSE: dict[str, Callable[[InstanceMasks, int], InstanceMasks]] = {
    "eroded": _worse(_morph(cv2.MORPH_ERODE, _EDGE)),
    "dilated": _worse(_morph(cv2.MORPH_DILATE, _EDGE)),
    "cut by a box": _worse(_cut_by_box),
    "without mirrors": _worse(_morph(cv2.MORPH_OPEN, _MIRROR)),
    "with a shadow": _worse(_with_shadow),
    "20 % hidden": _worse(_partly_hidden),
    "coarse": _worse(_coarse),
}
"""Ways to make masks worse, by name: functions of masks and a seed."""
