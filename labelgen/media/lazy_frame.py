"""A frame whose picture is made only when it is asked for, in colour or in grey."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from labelgen.media.frames import Frame, grey_of, shrunk

__all__ = ["LazyFrame"]

Picture = NDArray[np.uint8]


class LazyFrame(Frame):
    """A frame that stands for work not yet done.

    Args:
        number, time_s: as in `Frame`.
        convert: gives the picture, (H, W, 3) uint8 BGR.
        take_greys: gives its greys at a factor, (H // factor, W // factor) uint8; None where they must be made from the
            colours.
    """

    def __init__(
        self,
        number: int,
        time_s: float,
        convert: Callable[[], Picture],
        take_greys: Callable[[int], Picture | None],
    ) -> None:
        # What `Frame` is made of is frozen.
        self.__dict__.update(number=number, time_s=time_s, name="", _convert=convert, _take_greys=take_greys)

    @cached_property
    def image(self) -> Picture:
        """(H, W, 3) uint8 BGR."""
        picture: Picture = self.__dict__["_convert"]()
        return picture

    @cached_property
    def grey(self) -> Picture:
        """(H, W) uint8, the image without its colours."""
        greys: Picture | None = self.__dict__["_take_greys"](1)
        return grey_of(self.image) if greys is None else greys

    def small_grey(self, factor: int) -> Picture:
        """(H // factor, W // factor) uint8 greys; the frame is not gone through at full size for them."""
        greys: Picture | None = self.__dict__["_take_greys"](factor)
        return shrunk(self.grey, factor) if greys is None else greys
