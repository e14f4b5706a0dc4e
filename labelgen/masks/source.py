"""The interface of mask sources, their names, and how to run one along a video."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from enum import StrEnum
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError, LabelgenError, NoVehiclesError
from labelgen.masks.instances import InstanceMasks
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import Frame, FrameSource
from labelgen.media.prefetch import prefetch
from labelgen.media.sparse_frames import sparse_frames

__all__ = [
    "MaskKind",
    "MaskName",
    "MaskSource",
    "check_masks",
    "check_masks_file",
    "masked_frames",
    "parse_masks",
    "prime_masks",
]

# Frames apart from which a source is primed: neighbouring frames of traffic are too alike.
_PRIME_STRIDE = 10
_GATED = "gated"


class MaskKind(StrEnum):
    """Kinds of mask sources.

    MASKRCNN: instance segmentation by a network, `labelgen.masks.maskrcnn`.
    BACKGROUND: background subtraction, `labelgen.masks.background.source`.
    COCO: masks made before, read from a COCO JSON file, `labelgen.masks.coco`.
    ONNX: instance segmentation by a network of the user's, an ONNX file, `labelgen.masks.onnx`.
    """

    MASKRCNN = "maskrcnn"
    BACKGROUND = "background"
    COCO = "coco"
    ONNX = "onnx"

    @property
    def takes_file(self) -> bool:
        """Whether the name of the source goes with a file."""
        return self in (MaskKind.COCO, MaskKind.ONNX)


class MaskName(NamedTuple):
    """The name of a mask source, parsed.

    Attributes:
        kind: of the source; of the detections, where they gate a background model.
        file: masks or network; None for the other kinds.
        is_gated: whether the outlines come from a background model, see `labelgen.masks.gated`.
    """

    kind: MaskKind
    file: Path | None = None
    is_gated: bool = False

    @property
    def are_silhouettes(self) -> bool:
        """Whether the outlines come from a background model."""
        return self.is_gated or self.kind is MaskKind.BACKGROUND

    @property
    def label(self) -> str:
        """The name without the file."""
        return f"{_GATED}:{self.kind}" if self.is_gated else str(self.kind)

    @property
    def is_shaded(self) -> bool:
        """Whether masks include the shade under the vehicle, as a background model's do."""
        return self.is_gated or self.kind is MaskKind.BACKGROUND


class MaskSource(Protocol):
    """Finds the instance masks of the vehicles in the frames of one video.

    Contract between a source and its caller (`prime_masks` and `masked_frames` keep it):

    1. The caller calls `prime` once, before the first frame, where `prime_frames` is not 0. A source that needs no
       priming ignores the call.
    2. The caller passes through the frames in order. Where `every_frame` is k, not 0, it calls `observe` for each frame
       whose number is a multiple of k.
    3. It calls `masks` for the frames that it wants labelled, after their own `observe` and before the `observe` of
       later frames, with at most `batch_size` frames in one call.
    4. `masks` leaves the source's state as it is, apart from `problems`. So the masks of a frame depend only on the
       frames observed before it, not on which other frames were asked for.

    Attributes:
        every_frame: 0 for a source that need not observe; k for one that observes every k-th frame.
        prime_frames: number of frames at the beginning of the video from which `prime` takes its frames; 0 for none.
        batch_size: best number of frames in one call of `masks`. It is 1 where `masks` must follow `observe` frame by
            frame.
        problems: what has been skipped so far and why, one line for each kind. A source may change it in any call.
    """

    @property
    def every_frame(self) -> int: ...
    @property
    def prime_frames(self) -> int: ...
    @property
    def batch_size(self) -> int: ...
    @property
    def problems(self) -> list[str]: ...

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Learn from frames (H, W, 3) uint8 BGR of the beginning of the video, in order."""
        ...

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Update the source's state with one frame (H, W, 3) uint8 BGR."""
        ...

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """Return the instance masks of each image.

        Args:
            images: B frames (H, W, 3) uint8 BGR.
            frame_numbers: B numbers of the frames in the video, for sources that look masks up.
            file_names: B file names, for sources that look masks up; empty strings for frames of a video.

        Returns:
            B instance masks, in the order of the images.
        """
        ...


def parse_masks(masks: str) -> MaskName:
    """Parse the name of a mask source.

    Args:
        masks: "maskrcnn", "background", "coco:FILE" or "onnx:FILE"; "gated:" before any of them but background.

    Raises:
        LabelgenError: unknown name.
    """
    outer, separator, inner = masks.strip().partition(":")
    is_gated = outer == _GATED and bool(separator)
    name, _, file = inner.partition(":") if is_gated else (outer, separator, inner)
    if name in set(MaskKind) and MaskKind(name).takes_file == bool(file):
        kind = MaskKind(name)
        if not (is_gated and kind is MaskKind.BACKGROUND):
            return MaskName(kind, Path(file) if file else None, is_gated)
    raise LabelgenError(
        f"masks {masks}: unknown mask source; use one of maskrcnn, background, coco:FILE, onnx:FILE, gated:maskrcnn, "
        "gated:coco:FILE, gated:onnx:FILE",
        parameter="masks",
    )


def check_masks_file(masks: str) -> None:
    """Refuse masks whose file, of masks or of a network, is missing, before anything is opened.

    Raises:
        LabelgenError: unknown name of a mask source.
        DataError: no such file.
    """
    name = parse_masks(masks)
    if name.file is not None and not name.file.is_file():
        what = "a COCO JSON file" if name.kind is MaskKind.COCO else "a network for instance segmentation"
        raise DataError(f"{name.file}: no such file; masks {name.kind}:FILE needs {what}", parameter="masks")


def check_masks(source: MaskSource) -> None:
    """Refuse ready-made masks of which none belongs to the frames.

    Raises:
        NoVehiclesError: says why.
    """
    reason: NoVehiclesError | None = getattr(source, "no_masks", None)
    if reason is not None:
        raise reason


def prime_masks(source: MaskSource, frames: FrameSource) -> None:
    """Prime a source with the beginning of a video, where it asks for that; decode no more than it needs.

    Args:
        source: what to prime.
        frames: the video; not a live stream, which cannot be read a second time.
    """
    limit = source.prime_frames
    if limit:
        sampled = frames.frames(lambda number: number % _PRIME_STRIDE == 0)
        source.prime(frame.image for frame in takewhile(lambda frame: frame.number < limit, sampled))


def masked_frames(
    frames: FrameSource,
    source: MaskSource,
    choice: FrameChoice,
    group_of: Callable[[int], int] = lambda number: 0,
    *,
    ahead: int = 0,
) -> Generator[tuple[Frame, InstanceMasks]]:
    """Yield the chosen frames with their masks, in order; pass to the source what it observes on the way.

    Frames that are neither chosen nor observed are decoded only where others refer to them.

    Args:
        frames: the video.
        source: primed before, see `prime_masks`.
        choice: which frames; not only key frames where the source observes.
        group_of: group of a frame number. Frames of different groups never share a call of `MaskSource.masks`, so that
            the masks of a group do not depend on whether earlier groups were wanted.
        ahead: number of frames to decode ahead, in a thread; 0 for none, where the source does that itself.
    """
    stride, chooser = source.every_frame, choice.begin()
    chosen: set[int] = set()

    def is_needed(number: int) -> bool:
        if chooser.takes(number, True):
            chosen.add(number)
        return number in chosen or number % stride == 0

    coming = frames.frames(is_needed) if stride else sparse_frames(frames, choice)
    batch: list[Frame] = []
    with closing(prefetch(coming, ahead) if ahead else coming) as read:  # type: ignore[type-var]
        for frame in read:
            if stride and frame.number % stride == 0:
                source.observe(frame.image)
            is_last = bool(stride) and chooser.is_over and frame.number >= chooser.last
            if stride and frame.number not in chosen:
                if is_last:
                    break
                continue
            chosen.discard(frame.number)
            if batch and group_of(batch[0].number) != group_of(frame.number):
                yield from _find_masks(source, batch)
                batch = []
            batch.append(frame)
            if len(batch) >= source.batch_size:
                yield from _find_masks(source, batch)
                batch = []
            if is_last:
                break
    yield from _find_masks(source, batch)


def _find_masks(source: MaskSource, batch: list[Frame]) -> Iterator[tuple[Frame, InstanceMasks]]:
    if batch:
        images, numbers, names = zip(*((frame.image, frame.number, frame.name) for frame in batch), strict=True)
        yield from zip(batch, source.masks(images, numbers, names), strict=True)
