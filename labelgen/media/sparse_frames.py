"""A few frames of a source, without decoding more than they need."""

from __future__ import annotations

from collections.abc import Iterator

from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import Frame, FrameSource
from labelgen.media.video_reader import VideoFile

__all__ = ["sparse_frames"]


def sparse_frames(source: FrameSource, choice: FrameChoice) -> Iterator[Frame]:
    """Yield the chosen frames, in order, from the beginning of the source. The iterator may be abandoned.

    Frames, their numbers, times and pixels are those of `FrameSource.frames`. In a video other frames are decoded only
    where chosen ones refer to them; so `FrameSource.problems` does not list what is damaged between.

    Args:
        source: a video file, a folder of images, of which each decodes alone, or any other source, which is read whole.
        choice: which frames.
    """
    if isinstance(source, VideoFile):
        yield from source.sparse_frames(choice)
        return
    chooser = choice.begin()
    for frame in source.frames(lambda number: chooser.takes(number, True)):
        yield frame
        if chooser.is_over and frame.number >= chooser.last:
            return
