"""Detections from instance masks, for measuring without a trained detector and with exact masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.errors import RectificationError
from labelgen.geometry import Pair, Rectification, RoadMask, Rule, window_around
from labelgen.geometry.homography import Array
from labelgen.geometry.outline_label import mask_polygon
from labelgen.labeling.from_masks import LabelLimits, label_masks
from labelgen.labels import Labels
from labelgen.masks import InstanceMasks, MaskSource, masked_frames
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import Frame, FrameSource

__all__ = ["SPEED_LIMITS", "MaskDetections", "MaskPlacer"]

SPEED_LIMITS = LabelLimits(min_size_lwh_m=(0.0, 0.5, 0.0), max_size_lwh_m=(40.0, 6.0, 8.0))
"""Bounds of plausible sizes, metres; wider than for training labels. The length of a vehicle that is half hidden, or
seen from straight behind, is not known, but its contact point is. Narrower bounds would interrupt its track."""


class MaskPlacer:
    """Place the instance masks of frames as detections.

    Args:
        view: in which the detections lie.
        road: mask of the road; vehicles off the road are rejected.
        pair: for variants that build 3D boxes around outlines: of the rectified windows. For others, the view has it.
        rule: how the two candidates for c_c become one.
        limits: bounds outside which a mask is rejected.

    Attributes:
        rejects: number of masks that gave no detection, by reason.
    """

    def __init__(
        self,
        view: MeasurementView,
        road: RoadMask,
        pair: Pair,
        rule: Rule = Rule.WIDER,
        limits: LabelLimits = SPEED_LIMITS,
    ) -> None:
        self.view, self.rejects = view, Counter[str]()
        self._road, self._pair, self._rule, self._limits = road.pixels, pair, rule, limits

    def place(self, frame: int, time_s: float, masks: InstanceMasks) -> Detections:
        """Return the detections of a frame.

        Args:
            frame: number of the frame.
            time_s: seconds since the first frame.
            masks: of the frame.
        """
        if self.view.variant is Variant.ORIG2D:
            return self._orig2d(frame, time_s, masks)
        if self.view.variant.from_tangents:
            return self._tangents(frame, time_s, masks)
        assert self.view.rectification is not None
        labels = self._labels(masks, self.view.rectification)
        detections, valid = self.view.place(
            frame, time_s, labels.boxes_xyxy, labels.cc, labels.scores, labels.class_ids
        )
        self._count_invalid(valid)
        return detections

    def _labels(self, masks: InstanceMasks, rectification: Rectification) -> Labels:
        labels, rejects, _ = label_masks(masks, rectification, self.view.camera, self._road, self._rule, self._limits)
        self.rejects.update(reason for _, reason, _ in rejects)
        return labels

    def _count_invalid(self, valid: NDArray[np.bool_]) -> None:
        if not valid.all():
            self.rejects["no place on the road"] += int(np.count_nonzero(~valid))

    def _orig2d(self, frame: int, time_s: float, masks: InstanceMasks) -> Detections:
        on_road = np.array(
            [
                self._road[y : y + crop.shape[0], x : x + crop.shape[1]][crop].mean() >= self._limits.min_on_road
                for (x, y), crop in zip(masks.origins.tolist(), masks.crops, strict=True)
            ],
            dtype=np.bool_,
        )
        self.rejects["off the road"] += int(np.count_nonzero(~on_road))
        detections, valid = self.view.place(
            frame, time_s, masks.boxes_xyxy[on_road], None, masks.scores[on_road], masks.class_ids[on_road]
        )
        self._count_invalid(valid)
        return detections

    def _tangents(self, frame: int, time_s: float, masks: InstanceMasks) -> Detections:
        """Build each 3D box in a rectified window around its mask, which no image border cuts."""
        boxes, vertices, numbers = masks.boxes_xyxy, [], []
        for i in range(len(masks)):
            single = InstanceMasks(
                masks.frame_wh, masks.origins[i : i + 1], masks.crops[i : i + 1], masks.class_ids[i : i + 1],
                masks.scores[i : i + 1],
            )  # fmt: skip
            try:
                rectification = window_around(self.view.camera, boxes[i], self._pair)
            except RectificationError:
                self.rejects["window without a rectification"] += 1
                continue
            labels = self._labels(single, rectification)
            if len(labels):
                decoded, valid = labels.vertices(rectification.vpu)
                self._count_invalid(valid)
                if valid[0]:
                    vertices.append(rectification.points_back(decoded[0]))
                    numbers.append(i)
        index = np.array(numbers, dtype=np.int64)
        detections, valid = self.view.place(
            frame, time_s, boxes[index], None, masks.scores[index], masks.class_ids[index],
            np.array(vertices).reshape(-1, 8, 2), self._outlines(masks, numbers),
        )  # fmt: skip
        self._count_invalid(valid)
        return detections

    def _outlines(self, masks: InstanceMasks, numbers: Sequence[int]) -> list[Array] | None:
        if self.view.variant is not Variant.FITTED3D:
            return None
        polygons = (mask_polygon(masks.crops[i], tuple(masks.origins[i].tolist())) for i in numbers)
        return [polygon for polygon in polygons if polygon is not None]


class MaskDetections:
    """A mask source as a `detector.speed.detection_source.DetectionSource`.

    Args:
        masks: source of the masks; primed before, if it needs that.
        placer: places them as detections.
    """

    def __init__(self, masks: MaskSource, placer: MaskPlacer) -> None:
        self._masks, self._placer = masks, placer
        self.view, self.rejects = placer.view, placer.rejects

    @property
    def problems(self) -> list[str]:
        """What the mask source skipped so far, one line each."""
        return self._masks.problems

    def stream(self, frames: FrameSource) -> Iterator[tuple[Frame, Detections]]:
        """Yield frames with their detections; see `DetectionSource.stream`."""
        for frame, masks in masked_frames(frames, self._masks, FrameChoice()):
            yield frame, self._placer.place(frame.number, frame.time_s, masks)
