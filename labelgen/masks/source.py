"""The interface of everything that finds vehicles' masks in frames, and the way to make one by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError
from labelgen.masks.instances import InstanceMasks
from labelgen.media.frames import Frame, FrameSource

__all__ = ["MASK_SOURCES", "MaskSource", "create_mask_source", "masked_frames", "prime_masks"]

MASK_SOURCES = ("maskrcnn", "background", "coco:FILE")


class MaskSource(Protocol):
    """Frames in, instance masks out.

    The driver walks through the frames in order. It calls `prime` once before, where `prime_frames` > 0;
    `observe` on every frame whose number is a multiple of `every_frame`, where that is not 0; and `masks` on the frames
    it wants labelled, after observing them, at most `batch_size` at once. `masks` changes nothing, so what a frame
    gives depends only on the frames observed before it, not on which others were asked for.

    Attributes:
        name: "maskrcnn", "background" or "coco".
        every_frame: 0, or k to be shown every k-th frame through `observe`.
        prime_frames: how many frames from the beginning of the video `prime` wants to choose from; 0: none.
        batch_size: how many frames `masks` takes at once at best; 1 where it must follow `observe` frame by frame.
        problems: what had to be skipped so far, one line each.
    """

    @property
    def name(self) -> str: ...
    @property
    def every_frame(self) -> int: ...
    @property
    def prime_frames(self) -> int: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def problems(self) -> list[str]: ...

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Learn from the beginning of a video, (H, W, 3) uint8 BGR each, before the real pass."""
        ...

    def observe(self, image: NDArray[np.uint8]) -> None:
        """See one frame (H, W, 3) uint8 BGR in passing."""
        ...

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """The masks of each image (H, W, 3) uint8 BGR.

        Args:
            images: B frames.
            frame_numbers: B numbers in the video, for sources that look masks up.
            file_names: B file names, for the same; empty strings for frames of a video.
        """
        ...


def create_mask_source(
    spec: str,
    *,
    weights: str | Path | None = None,
    score_threshold: float = 0.5,
    road_mask: NDArray[Any] | None = None,
    device: str | None = None,
    frame_wh: tuple[int, int] | None = None,
) -> MaskSource:
    """A mask source by name.

    Args:
        spec: "maskrcnn", "background" or "coco:FILE".
        weights: maskrcnn only: a state dict to use in place of torchvision's COCO weights.
        score_threshold: masks with a lower score are left out.
        road_mask: (H, W) background only: vehicles must stand on it.
        device: maskrcnn only: a torch device such as "cuda:1"; a GPU if there is one by default.
        frame_wh: coco only: warn about masks made for another size of frame.

    Raises:
        LabelgenError: unknown name, or an option that the source does not have.
        DataError: weights or masks that cannot be used.
    """
    name, _, argument = spec.strip().partition(":")
    if weights is not None and name != "maskrcnn":
        raise LabelgenError(f"--weights: only --masks maskrcnn takes weights, not --masks {spec}")
    if name == "coco" and argument:
        from labelgen.masks.coco import CocoMasks

        return CocoMasks(argument, score_threshold=score_threshold, frame_wh=frame_wh)
    if name == "background" and not argument:
        from labelgen.masks.background.source import BackgroundMasks

        return BackgroundMasks(road_mask=road_mask, score_threshold=score_threshold)
    if name == "maskrcnn" and not argument:
        from labelgen.masks.maskrcnn import MaskRcnnMasks

        return MaskRcnnMasks(weights=weights, score_threshold=score_threshold, device=device)
    raise LabelgenError(f"--masks {spec}: unknown mask source; use one of {', '.join(MASK_SOURCES)}")


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
