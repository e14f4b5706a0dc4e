"""Sort many short series of grey levels at once: the samples of each pixel over time."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["sort_samples"]


def sort_samples(samples: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Sort samples (n, ...) along the first axis; the input is left unchanged.

    A fixed network of comparisons, each made for all series together, is many times faster than a sort of each series.
    It is fastest while all samples fit into the processor's cache.

    Args:
        samples: (n, ...) uint8.

    Returns:
        (n, ...) uint8, ascending along the first axis.

    Source: Batcher 1968; Knuth, The Art of Computer Programming 3, algorithm 5.2.2M (merge exchange).
    """
    rows = list(samples.copy())
    spare = np.empty_like(rows[0])
    for i, j in _comparators(len(rows)):
        np.minimum(rows[i], rows[j], out=spare)
        np.maximum(rows[i], rows[j], out=rows[j])
        rows[i], spare = spare, rows[i]
    return np.stack(rows)


@cache
def _comparators(n: int) -> tuple[tuple[int, int], ...]:
    """Return the comparators (i, j), i < j, of a sorting network for n inputs, in the order of execution."""
    comparators: list[tuple[int, int]] = []
    highest = 1 << max(0, (n - 1).bit_length() - 1)
    step = highest
    while step:
        other, offset, distance = highest, 0, step
        while True:
            comparators += [(i, i + distance) for i in range(n - distance) if i & step == offset]
            if other == step:
                break
            distance, other, offset = other - step, other >> 1, step
        step >>= 1
    return tuple(comparators)
