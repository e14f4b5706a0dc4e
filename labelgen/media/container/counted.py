"""Count what went wrong in a recording, and where first."""

from __future__ import annotations

__all__ = ["Counted"]


class Counted:
    """How often something happened, where first, and how large it was.

    Attributes:
        count: how often.
        first: number of the first frame.
        first_size, total: size of the first one, and of all together; the unit is the caller's.
    """

    def __init__(self) -> None:
        self.count = self.first = 0
        self.first_size = self.total = 0.0

    def add(self, number: int, size: float = 0.0) -> None:
        """Count one more, at the frame of this number."""
        if not self.count:
            self.first, self.first_size = number, size
        self.count += 1
        self.total += size
