"""Walking through a video with a mask source, in the order the source needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import takewhile

from labelgen.masks.instances import InstanceMasks
from labelgen.masks.source import MaskSource
from labelgen.media.frames import Frame, FrameSource

__all__ = ["masked_frames", "prime_masks"]

_PRIME_STRIDE = 10


def prime_masks(source: MaskSource, frames: FrameSource) -> None:
    """Let a source learn from the beginning of a video, if it wants to; decodes no more than it may choose from."""
    limit = source.prime_frames
    if limit:
        coming = frames.frames(lambda number: number % _PRIME_STRIDE == 0)
        source.prime(frame.image for frame in takewhile(lambda frame: frame.number < limit, coming))


def masked_frames(
    frames: FrameSource,
    source: MaskSource,
    taken: Callable[[int], bool],
    asked: Callable[[int], bool] = lambda number: True,
    group_of: Callable[[int], int] = lambda number: 0,
) -> Iterator[tuple[Frame, InstanceMasks | None]]:
    """Taken frames with their masks, in order; the source observes what it wants on the way.

    Args:
        frames: the video.
        source: primed before, see `prime_masks`.
        taken: whether a frame of this number is wanted.
        asked: whether the masks of a taken frame are wanted; None stands for them otherwise.
        group_of: frames of different groups are never given to the source together, so that what a group's frames
            give does not depend on whether the ones before it were asked for.
    """
    stride = source.every_frame
    batch: list[Frame] = []
    for frame in frames.frames(lambda number: taken(number) or bool(stride and number % stride == 0)):
        if stride and frame.number % stride == 0:
            source.observe(frame.image)
        if not taken(frame.number):
            continue
        if not asked(frame.number):
            yield from _ask(source, batch)
            batch = []
            yield frame, None
            continue
        if batch and group_of(batch[0].number) != group_of(frame.number):
            yield from _ask(source, batch)
            batch = []
        batch.append(frame)
        if len(batch) >= source.batch_size:
            yield from _ask(source, batch)
            batch = []
    yield from _ask(source, batch)


def _ask(source: MaskSource, batch: list[Frame]) -> Iterator[tuple[Frame, InstanceMasks]]:
    if batch:
        images, numbers, names = zip(*((frame.image, frame.number, frame.name) for frame in batch), strict=True)
        yield from zip(batch, source.masks(images, numbers, names), strict=True)
