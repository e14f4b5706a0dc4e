"""Which parts of a picture to draw, strip by strip."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

__all__ = ["strips"]


def strips(
    size_wh: tuple[int, int], rows_at_once: int, windows_xyxy: NDArray[np.int64] | None
) -> Iterator[tuple[slice, slice]]:
    """Yield the parts of a picture that cover all windows, as slices of rows and columns that do not overlap.

    Args:
        size_wh: of the picture, px.
        rows_at_once: height of a strip, px; the last one may be lower.
        windows_xyxy: (N, 4) px, the windows; None for the whole picture, then each strip is one part.
    """
    width, height = size_wh
    for top in range(0, height, rows_at_once):
        rows = slice(top, min(top + rows_at_once, height))
        if windows_xyxy is None:
            yield rows, slice(0, width)
            continue
        crossing = windows_xyxy[(windows_xyxy[:, 1] < rows.stop) & (windows_xyxy[:, 3] > rows.start)]
        needed = np.zeros(width + 1, dtype=np.bool_)
        for x0, _, x1, _ in crossing.clip(0, width).tolist():
            needed[x0:x1] = True
        edges = np.flatnonzero(np.diff(needed, prepend=False)).tolist()
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            yield rows, slice(start, stop)
