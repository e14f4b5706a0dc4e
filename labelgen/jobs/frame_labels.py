"""Labels of a video's frames in the order of time: frame by frame, or in parts with what comes before and after."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from labelgen.choices import Region, Rule
from labelgen.datasets.scene import Scene
from labelgen.geometry.rectification import Rectification
from labelgen.labeling.fitted.label import SeenFrame, label_passages
from labelgen.labeling.fitted.settings import MaskErrors
from labelgen.labeling.from_masks import flat_labels, label_masks
from labelgen.labeling.screening import FrameLabels, LabelLimits
from labelgen.masks import InstanceMasks
from labelgen.media.frames import Frame

__all__ = ["FrameLabeler", "LabelledFrame", "PassageLabeler", "SingleFrameLabeler"]


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """One frame with what its masks gave.

    Args:
        number: of the frame.
        time_s: seconds.
        encoded: JPEG or PNG bytes of the rectified frame; empty where no label needs them.
        given: its labels, rejects and boxes to ignore.
    """

    number: int
    time_s: float
    encoded: bytes
    given: FrameLabels


class FrameLabeler(Protocol):
    """Turns frames with masks, given in order, into labelled frames in the same order."""

    def add(self, frame: Frame, masks: InstanceMasks) -> Iterator[LabelledFrame]:
        """Take the next frame; yield what is ready."""
        ...

    def finish(self) -> Iterator[LabelledFrame]:
        """Yield the rest."""
        ...


@dataclass(frozen=True, eq=False)
class SingleFrameLabeler:
    """Labels each frame by itself.

    Args:
        scene: the video.
        rectification: of its frames.
        region: what is rectified; `Region.NONE` gives 2D boxes alone.
        rule: how the two candidates become one c_c.
        limits: thresholds.
        encode: turns a rectified frame into bytes.
    """

    scene: Scene
    rectification: Rectification
    region: Region
    rule: Rule
    limits: LabelLimits
    encode: Callable[[Frame], bytes]

    def add(self, frame: Frame, masks: InstanceMasks) -> Iterator[LabelledFrame]:
        """See `FrameLabeler`."""
        road = self.scene.road.pixels
        if self.region is Region.NONE:
            given = flat_labels(masks, self.rectification, road, self.limits)
        else:
            given = label_masks(masks, self.rectification, self.scene.camera, road, self.rule, self.limits)
        encoded = self.encode(frame) if len(given.labels) else b""
        yield LabelledFrame(frame.number, frame.time_s, encoded, given)

    def finish(self) -> Iterator[LabelledFrame]:
        """See `FrameLabeler`."""
        return iter(())


class PassageLabeler:
    """Labels frames with bodies fitted to passages, a part of the video at a time.

    The labels of a part depend on its frames and on those within `overlap` frames around it, and on nothing else, so
    that a job that goes on after an interruption gives the same bytes.

    Args:
        scene: the video.
        rectification: of its frames.
        limits: thresholds.
        encode: turns a rectified frame into bytes.
        are_silhouettes: whether the masks come from the background model.
        part_frames: length of a part, in numbers of frames.
        overlap: how many frames around a part decide its labels, in numbers of frames.
        first: number of the first frame that is wanted; earlier ones are context.
    """

    def __init__(
        self, scene: Scene, rectification: Rectification, limits: LabelLimits, encode: Callable[[Frame], bytes], *,
        are_silhouettes: bool, part_frames: int, overlap: int, first: int,
    ) -> None:  # fmt: skip
        self._scene, self._rectification, self._limits, self._are_silhouettes = (
            scene, rectification, limits, are_silhouettes,
        )  # fmt: skip
        self._encode, self._part_frames, self._overlap = encode, part_frames, overlap
        self._start = first
        self._seen: list[SeenFrame] = []
        self._encoded: dict[int, bytes] = {}

    def add(self, frame: Frame, masks: InstanceMasks) -> Iterator[LabelledFrame]:
        """See `FrameLabeler`."""
        while frame.number >= self._start + self._part_frames + self._overlap:
            yield from self._label_part()
        self._seen.append(SeenFrame(frame.number, frame.time_s, masks))
        if len(masks) and frame.number >= self._start:
            self._encoded[frame.number] = self._encode(frame)

    def finish(self) -> Iterator[LabelledFrame]:
        """See `FrameLabeler`."""
        while self._seen and self._seen[-1].number >= self._start:
            yield from self._label_part()

    def _label_part(self) -> Iterator[LabelledFrame]:
        start, end = self._start, self._start + self._part_frames
        window = [f for f in self._seen if start - self._overlap <= f.number < end + self._overlap]
        window_masks = [f.masks for f in window]
        labelled = label_passages(
            window, self._rectification, self._scene.camera, self._scene.road.pixels,
            MaskErrors.of(window_masks, are_silhouettes=self._are_silhouettes), self._limits,
        )  # fmt: skip
        for seen, given in zip(window, labelled, strict=True):
            if start <= seen.number < end:
                encoded = self._encoded.pop(seen.number, b"")
                yield LabelledFrame(seen.number, seen.time_s, encoded if len(given.labels) else b"", given)
        self._start = end
        self._seen = [f for f in self._seen if f.number >= end - self._overlap]
