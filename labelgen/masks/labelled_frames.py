"""Frames with the masks that labels are made of: those of a background model are told to move or not."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import replace

from labelgen.geometry.camera import Camera
from labelgen.masks.background.motion import MOTION, find_moving, working_grey
from labelgen.masks.background.source import BackgroundMasks
from labelgen.masks.instances import InstanceMasks
from labelgen.masks.source import MaskSource, masked_frames
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import Frame, FrameSource
from labelgen.media.klt import Grey
from labelgen.media.prefetch import prefetch

__all__ = ["labelled_frames"]


def labelled_frames(
    frames: FrameSource,
    source: MaskSource,
    camera: Camera,
    choice: FrameChoice,
    group_of: Callable[[int], int] = lambda number: 0,
    *,
    ahead: int = 0,
) -> Generator[tuple[Frame, InstanceMasks]]:
    """Yield the chosen frames with their masks, as `labelgen.masks.masked_frames` does.

    A background model finds all that differs from the empty scene, so its masks come with `InstanceMasks.moving`.
    That depends on frames at fixed distances from the chosen one, not on which other frames are wanted.

    Args:
        frames, source, choice, group_of, ahead: see `masked_frames`.
        camera: of the frames.
    """
    if isinstance(source, BackgroundMasks):
        yield from _told_to_move(frames, source, camera, choice, ahead)
    else:
        yield from masked_frames(frames, source, choice, group_of, ahead=ahead)


def _told_to_move(
    frames: FrameSource, source: BackgroundMasks, camera: Camera, choice: FrameChoice, ahead: int
) -> Generator[tuple[Frame, InstanceMasks]]:
    offsets, fps = MOTION.offsets(frames.fps), frames.fps
    greys: dict[int, Grey] = {}
    waiting: deque[tuple[Frame, InstanceMasks]] = deque()

    def is_compared(number: int) -> bool:
        return choice.takes_number(number) or any(choice.takes_number(number - offset) for offset in offsets)

    coming = frames.frames(lambda number: number % source.every_frame == 0 or is_compared(number))
    with closing(prefetch(coming, ahead) if ahead else coming) as read:  # type: ignore[type-var]
        for frame in read:
            number = frame.number
            if number % source.every_frame == 0:
                source.observe(frame.image)
            if is_compared(number):
                greys[number] = working_grey(frame.image)
            if choice.takes_number(number):
                waiting.append((frame, source.masks([frame.image], [number], [frame.name])[0]))
            while waiting and waiting[0][0].number + max(offsets) <= number:
                yield _told(*waiting.popleft(), greys, camera, fps)
            oldest = (waiting[0][0].number if waiting else number) + min(offsets)
            for old in [old for old in greys if old < oldest]:
                del greys[old]
            if choice.limit is not None and number >= choice.every * (choice.limit - 1) + max(offsets):
                break
    for entry in waiting:
        yield _told(*entry, greys, camera, fps)


def _told(
    frame: Frame, masks: InstanceMasks, greys: Mapping[int, Grey], camera: Camera, fps: float | None
) -> tuple[Frame, InstanceMasks]:
    numbers = [(offset, frame.number + offset) for offset in MOTION.offsets(fps)]
    others = [(MOTION.looks(offset, fps), greys[number]) for offset, number in numbers if number in greys]
    moving = find_moving(masks, greys[frame.number], others, camera, if_unknown=not MOTION.can_follow(fps))
    return frame, replace(masks, moving=moving)
