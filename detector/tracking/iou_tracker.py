"""Online tracking of 2D boxes by their overlap.

Source: Kocur & Ftacnik 2020, section 3.5. A box continues the track whose last box it overlaps most, if their
intersection over union (IoU) is above 0.1. A track ends after 10 frames without a box.

The paper leaves four things open. This module decides them so:

- The pair of box and track with the greatest IoU is joined first, in any order of the boxes.
- Of equal IoUs, the box with the better score is joined first, then the older track.
- A box that overlaps a better box of its frame almost completely is a duplicate and joins no track.
- Where two vehicles merge into one box, the track with the greater IoU goes on. The other track waits; it goes on too
  if the vehicles part before it ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.errors import DataError
from labelgen.geometry.boxes import iou_matrix
from labelgen.geometry.homography import Array

__all__ = ["DUPLICATE", "IouTracker", "TrackRules"]

IntArray = NDArray[np.int64]

DUPLICATE = -1
"""Track number of boxes that are duplicates of a better one."""


@dataclass(frozen=True)
class TrackRules:
    """Thresholds of the tracker. All but `duplicate_iou` are the published ones.

    Args:
        min_iou: IoU in [0, 1]; a box continues a track only above it. A lower one joins neighbours, a higher one splits
            the tracks of fast vehicles.
        max_missed: frames without a box after which a track still goes on. More bridge longer occlusions, and join
            vehicles that follow each other.
        duplicate_iou: IoU in [0, 1]; boxes of one frame that overlap a better one by more than this are duplicates.
            1 keeps all boxes. A lower one removes vehicles that hide each other.

    Raises:
        DataError: a value is out of its range.
    """

    min_iou: float = 0.1
    max_missed: int = 10
    duplicate_iou: float = 0.8

    def __post_init__(self) -> None:
        problems = [
            f"{name}: expected 0 to 1, got {value}"
            for name, value in (("min_iou", self.min_iou), ("duplicate_iou", self.duplicate_iou))
            if not 0 <= value <= 1
        ]
        if self.max_missed < 0:
            problems.append(f"max_missed: expected 0 or more, got {self.max_missed}")
        if problems:
            raise DataError("tracking rules: " + "; ".join(problems))


class IouTracker:
    """Online tracker of the boxes of one camera.

    Args:
        rules: thresholds; the published ones where left out.
    """

    def __init__(self, rules: TrackRules | None = None) -> None:
        self.rules = rules or TrackRules()
        self._frame = -1
        self._next_id = 1
        self._ids: IntArray = np.empty(0, dtype=np.int64)
        self._boxes: Array = np.empty((0, 4))
        self._last_frames: IntArray = np.empty(0, dtype=np.int64)

    def update(self, frame: int, boxes_xyxy: ArrayLike, scores: ArrayLike | None = None) -> tuple[IntArray, list[int]]:
        """Assign the boxes of a frame to tracks.

        Args:
            frame: number of the frame, greater than the last one; numbers left out count as frames without boxes.
            boxes_xyxy: (N, 4) px; N may be 0.
            scores: (N,) decide between duplicates and between equal overlaps; all equal where left out.

        Returns:
            ids (N,), the track of each box, `DUPLICATE` for duplicates; and the tracks that have ended before this
            frame.

        Raises:
            DataError: the frame's number is not greater than the last one, or a box is not finite.
        """
        boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
        weight = np.ones(len(boxes)) if scores is None else np.asarray(scores, dtype=np.float64)
        if frame <= self._frame:
            raise DataError(f"tracker: frame {frame} after frame {self._frame}; give frames in order, each once")
        if not np.isfinite(boxes).all():
            raise DataError(f"tracker: a box of frame {frame} is not finite")
        self._frame = frame
        ended = self._end(frame - self._last_frames > self.rules.max_missed + 1)

        ids = np.full(len(boxes), DUPLICATE, dtype=np.int64)
        unique = self._without_duplicates(boxes, weight)
        track_of = self._match(boxes[unique], weight[unique])
        continued = track_of >= 0
        rows = track_of[continued]
        ids[unique[continued]] = self._ids[rows]
        self._boxes[rows], self._last_frames[rows] = boxes[unique[continued]], frame

        new = unique[~continued]
        ids[new] = np.arange(self._next_id, self._next_id + len(new))
        self._next_id += len(new)
        self._ids = np.concatenate([self._ids, ids[new]])
        self._boxes = np.concatenate([self._boxes, boxes[new]])
        self._last_frames = np.concatenate([self._last_frames, np.full(len(new), frame)])
        return ids, ended

    def finish(self) -> list[int]:
        """End all tracks and return their numbers."""
        return self._end(np.ones(len(self._ids), dtype=np.bool_))

    def _end(self, over: NDArray[np.bool_]) -> list[int]:
        ended = [int(number) for number in self._ids[over]]
        self._ids, self._boxes, self._last_frames = self._ids[~over], self._boxes[~over], self._last_frames[~over]
        return ended

    def _without_duplicates(self, boxes: Array, scores: Array) -> IntArray:
        """Return the numbers of the boxes that are no duplicates of a better one, in their own order."""
        order = np.argsort(-scores, kind="stable")
        overlapping = np.triu(iou_matrix(boxes[order], boxes[order]) > self.rules.duplicate_iou, 1)
        keep = np.ones(len(boxes), dtype=np.bool_)
        for better in np.flatnonzero(overlapping.any(axis=1)).tolist():
            if keep[better]:
                keep[overlapping[better]] = False
        return np.sort(order[keep])

    def _match(self, boxes: Array, scores: Array) -> IntArray:
        """Return (N,) the row of the track that each box continues; -1 for none."""
        overlap = iou_matrix(boxes, self._boxes)
        box, track = np.nonzero(overlap > self.rules.min_iou)
        order = np.lexsort((track, -scores[box], -overlap[box, track]))
        track_of = np.full(len(boxes), -1, dtype=np.int64)
        taken = np.zeros(len(self._ids), dtype=np.bool_)
        for b, t in zip(box[order].tolist(), track[order].tolist(), strict=True):
            if track_of[b] < 0 and not taken[t]:
                track_of[b], taken[t] = t, True
        return track_of
