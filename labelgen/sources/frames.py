"""Frames in order, from a video file or a folder of images: one interface for both.

Convention: images are (H, W, 3) uint8 BGR; frames are numbered from 0 in the order they are shown; times are seconds
since the first frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError

__all__ = ["Frame", "FrameSource", "always", "open_frames"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame.

    Args:
        number: position in the source, from 0.
        time_s: its own time stamp relative to the first frame's; NaN in a folder of images.
        image: (H, W, 3) uint8 BGR.
        name: file name in a folder of images, relative to it; empty in a video.
    """

    number: int
    time_s: float
    image: NDArray[np.uint8]
    name: str = ""


def always(number: int) -> bool:
    """Every frame is wanted."""
    return True


class FrameSource(Protocol):
    """Where frames come from.

    Attributes:
        name: short name for messages and outputs, without the file's suffix.
        path: the video file or the folder.
        size_wh: px, after any rotation the file asks for.
        frame_count: how many frames the file announces; may be wrong; None where it announces nothing.
        fps: average announced frame rate; None where there is none.
        problems: what the last iteration had to skip or could not read, one line each.
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
    def fps(self) -> float | None: ...
    @property
    def problems(self) -> list[str]: ...

    def frames(self, wanted: Callable[[int], bool] = always) -> Iterator[Frame]:
        """The wanted frames, in order. Every call starts at the beginning; abandoning the iterator is fine.

        Args:
            wanted: whether the frame of this number is to be converted and given; others cost only their decoding.
        """
        ...


def open_frames(path: str | Path, *, threads: int = 0) -> FrameSource:
    """A video file or a folder of images, ready to iterate.

    Args:
        path: video file in any format FFmpeg reads, or a folder with *.jpg, *.png, *.bmp, *.tif or *.webp files.
        threads: decoding threads for a video; 0 leaves it to the decoder.

    Raises:
        DataError: nothing there, or nothing in it that can be read as a frame.
    """
    from labelgen.sources.images import ImageFolder
    from labelgen.sources.video import VideoFile

    path = Path(path)
    if path.is_dir():
        return ImageFolder(path)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; give a video file or a folder of images")
    return VideoFile(path, threads=threads)
