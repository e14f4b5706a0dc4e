"""Problems of many items of an input, counted by kind: one line for each kind, with an example."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["ProblemCounts", "count_of"]


class ProblemCounts:
    """Counts of skipped items by kind; the memory does not grow with the number of items."""

    def __init__(self) -> None:
        self._kinds: dict[tuple[str, str], list[Any]] = {}

    def add(self, kind: str, example: str | Callable[[], str], *, noun: str = "annotation") -> None:
        """Count one skipped item.

        Args:
            kind: what is wrong, the same for all items of a kind.
            example: the item and what is wrong with it, or a function that returns that; the first of a kind is told.
            noun: what the item is.
        """
        known = self._kinds.get((noun, kind))
        if known is None:
            self._kinds[noun, kind] = [1, example if isinstance(example, str) else example()]
        else:
            known[0] += 1

    def lines(self) -> list[str]:
        """Return one line for each kind, in the order in which the kinds came."""
        return [
            f"{example}; skipped" if count == 1 else f"{count_of(count, noun)} skipped: {kind}, such as {example}"
            for (noun, kind), (count, example) in self._kinds.items()
        ]


def count_of(count: int, noun: str) -> str:
    """Return a number of things as text, such as "3 annotations"."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{count} {noun if count == 1 else plural}"
