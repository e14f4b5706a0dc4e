"""Frames in order, from a video file, a folder of images or a camera stream: one interface for all.

Convention: images are (H, W, 3) uint8 BGR; frames are numbered from 0 in the order they are shown; times are seconds
since the first frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Frame", "FrameSource", "LazyFrame", "always", "downscale", "to_grey"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame.

    Args:
        number: position in the source, from 0.
        time_s: its time since the first frame, s; NaN where the source has neither time stamps nor a frame rate.
        image: (H, W, 3) uint8 BGR.
        name: file name in a folder of images, relative to it; empty in a video.
        gaps_s: how much of its time lies in gaps of the recording, s.
    """

    number: int
    time_s: float
    image: NDArray[np.uint8]
    name: str = ""
    gaps_s: float = 0.0

    @property
    def shown_s(self) -> float:
        """How much of the recording was shown before this frame, s: its time without gaps."""
        return self.time_s - self.gaps_s

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """(H, W) uint8 grey levels of the image."""
        return to_grey(self.image)

    def small_grey(self, factor: int) -> NDArray[np.uint8]:
        """Return the grey levels downscaled by a factor, (H // factor, W // factor) uint8; see `downscale`."""
        return downscale(self.grey, factor)


def downscale(picture: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Downscale a picture (H, W[, C]) uint8 to (H // factor, W // factor) by area averaging."""
    if factor == 1:
        return picture
    size = tuple(max(1, n // factor) for n in picture.shape[1::-1])
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a picture (H, W, 3) uint8 BGR to (H, W) uint8 grey levels."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def always(number: int) -> bool:
    """Return True for every frame number."""
    return True


class FrameSource(Protocol):
    """Frames of a video file, a folder of images or a camera stream.

    Attributes:
        name: short name for messages and outputs, without the file's suffix.
        path: the video file or the folder; for a stream a relative path made of the last part of its address.
        size_wh: px, of upright frames with square pixels.
        frame_count: number of frames that the file announces, which may be wrong; None where none is announced.
        count_is_exact: whether the source states that number itself, rather than a duration.
        fps: frames per second, as given, announced or measured; None where nothing says it.
        is_live: whether the frames come once, as a camera sends them. Other sources can be read again.
        untimed: why frames have no times, in words; empty where they have.
        notes: what was assumed or applied when the source was opened, one line each.
        problems: what the last iteration skipped or could not read, one line each.
        failure: why the last iteration of a stream broke off; None for files and where nothing broke off.
    """

    @property
    def name(self) -> str: ...
    @property
    def path(self) -> Path: ...
    @property
    def size_wh(self) -> tuple[int, int]: ...
    @property
    def frame_count(self) -> int | None: ...
    @property
    def count_is_exact(self) -> bool: ...
    @property
    def fps(self) -> float | None: ...
    @property
    def is_live(self) -> bool: ...
    @property
    def untimed(self) -> str: ...
    @property
    def notes(self) -> list[str]: ...
    @property
    def problems(self) -> list[str]: ...
    @property
    def failure(self) -> Exception | None: ...

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """Return the wanted frames, in order, from the beginning of the source. The iterator may be abandoned.

        Args:
            wanted: whether to convert and yield the frame of this number. Other frames are only decoded.
            not_before_s: asked again for every frame; returns the time, s, before which no frame is wanted. A source
                may skip such frames undecoded, and some wanted frames after that time with them, and may yield
                `LazyFrame`s. Sources that cannot skip ignore it.

        Raises:
            DataError: a live source is read a second time.
        """
        ...


Picture = NDArray[np.uint8]


class LazyFrame(Frame):
    """A frame whose picture is converted when it is first read.

    Args:
        number, time_s, gaps_s: as in `Frame`.
        convert: returns the picture, (H, W, 3) uint8 BGR.
        read_grey: returns the grey levels downscaled by a factor, (H // factor, W // factor) uint8; None where they
            must be computed from the colours.
    """

    def __init__(
        self,
        number: int,
        time_s: float,
        convert: Callable[[], Picture],
        read_grey: Callable[[int], Picture | None],
        gaps_s: float = 0.0,
    ) -> None:
        # `Frame` is frozen, so its fields cannot be assigned.
        self.__dict__.update(number=number, time_s=time_s, name="", gaps_s=gaps_s)
        self.__dict__.update(_convert=convert, _read_grey=read_grey)

    @cached_property
    def image(self) -> Picture:
        """(H, W, 3) uint8 BGR."""
        picture: Picture = self.__dict__["_convert"]()
        return picture

    @cached_property
    def grey(self) -> Picture:
        """(H, W) uint8 grey levels of the image."""
        grey: Picture | None = self.__dict__["_read_grey"](1)
        return to_grey(self.image) if grey is None else grey

    def small_grey(self, factor: int) -> Picture:
        """Return the grey levels downscaled by a factor, without converting the frame at full size where possible."""
        grey: Picture | None = self.__dict__["_read_grey"](factor)
        return downscale(self.grey, factor) if grey is None else grey
