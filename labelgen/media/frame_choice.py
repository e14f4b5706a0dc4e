"""Which frames of a recording are wanted: every so many-th, or key frames so far apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from labelgen.media.frames import always

__all__ = ["FrameChoice", "FrameChooser"]


@dataclass(frozen=True)
class FrameChoice:
    """Frames of a recording.

    Args:
        every: take every so many-th frame; with `keyframes`, the least number of frames from one taken frame to the
            next.
        keyframes: take only frames that decode alone.
        limit: largest number of frames to take; None for all.
        wanted: whether a taken frame of this number is wanted. It must depend on the number alone: it is asked ahead,
            and perhaps again.
    """

    every: int = 1
    keyframes: bool = False
    limit: int | None = None
    wanted: Callable[[int], bool] = always

    def takes_number(self, number: int) -> bool:
        """Return whether a frame is wanted, where `keyframes` is not set: then its number alone decides."""
        is_within = number >= 0 and (self.limit is None or number < self.limit * self.every)
        return is_within and number % self.every == 0 and self.wanted(number)

    def begin(self) -> FrameChooser:
        """Return the state of one pass over a recording."""
        return FrameChooser(self)


class FrameChooser:
    """Choose the frames of one pass over a recording.

    Args:
        choice: which frames are wanted.

    Attributes:
        last: number of the last frame that was taken; -1 before the first.
    """

    def __init__(self, choice: FrameChoice) -> None:
        self._choice = choice
        self._taken, self.last = 0, -1

    @property
    def is_over(self) -> bool:
        """Whether no later frame is taken."""
        return self._choice.limit is not None and self._taken >= self._choice.limit

    def takes(self, number: int, is_key: bool) -> bool:
        """Return whether a frame is wanted; to be asked in the order of the numbers."""
        choice = self._choice
        if self.is_over:
            return False
        if choice.keyframes:
            is_taken = is_key and (self.last < 0 or number >= self.last + choice.every)
        else:
            is_taken = number % choice.every == 0
        if not is_taken:
            return False
        self._taken, self.last = self._taken + 1, number
        return choice.wanted(number)
