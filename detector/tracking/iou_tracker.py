"""Tracking by overlap, frame by frame.

Source: Kocur & Ftacnik 2020, section 3.5: a box continues the track whose last box it overlaps most, if their
intersection over union is above 0.1; a track ends after 10 frames without a box.

What the text leaves open is settled so: the pair of box and track with the greatest overlap is joined first, whatever
the order of the boxes; equal overlaps go to the better score, then to the older track. A box that all but repeats a
better one of its frame is a duplicate and joins no track. Where two vehicles merge into one box, the track that it
overlaps more goes on and the other one waits; it goes on too if they part in time.
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
"""Track number of boxes that repeat a better one."""


@dataclass(frozen=True)
class TrackRules:
    """Parameters of the tracker; the defaults are the published ones, but for `duplicate_iou`, which is ours.

    Args:
        min_iou: a box continues a track only with an overlap above this one.
        max_missed: frames without a box that a track survives.
        duplicate_iou: boxes of one frame that overlap a better one by more than this are duplicates; 1 keeps all.
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
    """Tracks boxes online.

    Args:
        rules: parameters.

    Attributes:
        active: numbers of the tracks that may still go on, oldest first.
    """

    def __init__(self, rules: TrackRules | None = None) -> None:
        self.rules = rules or TrackRules()
        self._last_frame = -1
        self._next = 1
        self._ids: IntArray = np.empty(0, dtype=np.int64)
        self._boxes: Array = np.empty((0, 4))
        self._seen: IntArray = np.empty(0, dtype=np.int64)

    @property
    def active(self) -> list[int]:
        """Numbers of the tracks that may still go on, oldest first."""
        return [int(number) for number in self._ids]

    def update(self, frame: int, boxes_xyxy: ArrayLike, scores: ArrayLike | None = None) -> tuple[IntArray, list[int]]:
        """Take in the boxes of a frame.

        Args:
            frame: its number, greater than the last one; numbers left out count as frames without boxes.
            boxes_xyxy: (N, 4); none is fine.
            scores: (N,) by which duplicates and equal overlaps are decided; all equal where left out.

        Returns:
            ids (N,), the track each box belongs to, `DUPLICATE` for none; and the tracks that have ended before
            this frame.

        Raises:
            DataError: the frame's number is not greater than the last one, or a box is not finite.
        """
        boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
        weight = np.ones(len(boxes)) if scores is None else np.asarray(scores, dtype=np.float64)
        if frame <= self._last_frame:
            raise DataError(f"tracker: frame {frame} after frame {self._last_frame}; give frames in order, each once")
        if not np.isfinite(boxes).all():
            raise DataError(f"tracker: a box of frame {frame} is not finite")
        self._last_frame = frame
        ended = self._end(frame - self._seen > self.rules.max_missed + 1)

        ids = np.full(len(boxes), DUPLICATE, dtype=np.int64)
        kept = self._without_duplicates(boxes, weight)
        track_of = self._match(boxes[kept], weight[kept])
        known = track_of >= 0
        rows = track_of[known]
        ids[kept[known]] = self._ids[rows]
        self._boxes[rows], self._seen[rows] = boxes[kept[known]], frame

        new = kept[~known]
        ids[new] = np.arange(self._next, self._next + len(new))
        self._next += len(new)
        self._ids = np.concatenate([self._ids, ids[new]])
        self._boxes = np.concatenate([self._boxes, boxes[new]])
        self._seen = np.concatenate([self._seen, np.full(len(new), frame)])
        return ids, ended

    def finish(self) -> list[int]:
        """End all tracks; returns their numbers."""
        return self._end(np.ones(len(self._ids), dtype=np.bool_))

    def _end(self, over: NDArray[np.bool_]) -> list[int]:
        ended = [int(number) for number in self._ids[over]]
        self._ids, self._boxes, self._seen = self._ids[~over], self._boxes[~over], self._seen[~over]
        return ended

    def _without_duplicates(self, boxes: Array, scores: Array) -> IntArray:
        """Numbers of the boxes that repeat no better one, in their own order."""
        order = np.argsort(-scores, kind="stable")
        overlapping = np.triu(iou_matrix(boxes[order], boxes[order]) > self.rules.duplicate_iou, 1)
        keep = np.ones(len(boxes), dtype=np.bool_)
        for better in np.flatnonzero(overlapping.any(axis=1)).tolist():
            if keep[better]:
                keep[overlapping[better]] = False
        return np.sort(order[keep])

    def _match(self, boxes: Array, scores: Array) -> IntArray:
        """(N,) row of the track that each box continues; -1 for none."""
        overlap = iou_matrix(boxes, self._boxes)
        box, track = np.nonzero(overlap > self.rules.min_iou)
        order = np.lexsort((track, -scores[box], -overlap[box, track]))
        found = np.full(len(boxes), -1, dtype=np.int64)
        taken = np.zeros(len(self._ids), dtype=np.bool_)
        for b, t in zip(box[order].tolist(), track[order].tolist(), strict=True):
            if found[b] < 0 and not taken[t]:
                found[b], taken[t] = t, True
        return found
