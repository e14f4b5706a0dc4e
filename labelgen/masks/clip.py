"""The frames that ready-made masks belong to, as far as looking masks up needs to know them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from labelgen.media.frames import FrameSource
from labelgen.media.image_folder import ImageFolder

__all__ = ["Clip"]


@dataclass(frozen=True)
class Clip:
    """The frames of one video or folder of images.

    Args:
        path: the video file or the folder.
        frame_wh: size of the frames, px.
        frame_count: number of frames that the file states; None where it states none.
        file_names: names of the images of a folder, in order; None for a video.
        every: every so many-th frame is asked for.
    """

    path: Path
    frame_wh: tuple[int, int] | None = None
    frame_count: int | None = None
    file_names: tuple[str, ...] | None = None
    every: int = 1

    @classmethod
    def of(cls, frames: FrameSource, *, every: int = 1) -> Clip:
        """Describe opened frames, of which every so many-th is asked for."""
        names = tuple(frames.file_names) if isinstance(frames, ImageFolder) else None
        # A number computed from a duration may be too low, and masks beyond it would be lost.
        count = frames.frame_count if frames.count_is_exact else None
        return cls(frames.path, frames.size_wh, count, names, every)
