"""Instance masks of one frame, each cropped to its bounding box: the output of every mask source.

Convention: pixels are areas; a crop (h, w) with origin (x, y) covers the frame's pixels [x, x + w) x [y, y + h).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.errors import DataError
from labelgen.labels import VehicleClass

__all__ = ["Crop", "InstanceMasks", "crop_mask"]

BoolMask = NDArray[np.bool_]
Crop = tuple[tuple[int, int], BoolMask]
"""Origin (x, y) of a crop in the frame, px, and the crop (h, w) bool."""


@dataclass(frozen=True, eq=False)
class InstanceMasks:
    """N instance masks of one frame, as a structure of arrays.

    Args:
        frame_wh: size of the frame, px.
        origins: (N, 2) int64, x and y of each crop's first pixel in the frame.
        crops: N bool arrays (h_i, w_i), each with at least one pixel set, inside the frame.
        class_ids: (N,) uint8, `labelgen.labels.VehicleClass`.
        scores: (N,) float32 in [0, 1].
        are_predicted: whether a network made them: it may find a vehicle twice, and its masks may end short of the
            frame's border.
        moving: (N,) bool, whether each moves along the road; None where that was not looked at.

    Raises:
        DataError: a field has a wrong shape or value. The message lists all such fields, expected beside actual.
    """

    frame_wh: tuple[int, int]
    origins: NDArray[np.int64]
    crops: tuple[BoolMask, ...]
    class_ids: NDArray[np.uint8]
    scores: NDArray[np.float32]
    are_predicted: bool = False
    moving: BoolMask | None = None

    def __post_init__(self) -> None:
        crops = tuple(self.crops)
        n = len(crops)
        origins = np.asarray(self.origins, dtype=np.int64)
        class_ids = np.asarray(self.class_ids, dtype=np.uint8)
        scores = np.asarray(self.scores, dtype=np.float32)
        moving = None if self.moving is None else np.asarray(self.moving, dtype=np.bool_)
        problems = [
            f"{name}: expected shape {expected}, got {array.shape}"
            for name, array, expected in (
                ("origins", origins, (n, 2)),
                ("class_ids", class_ids, (n,)),
                ("scores", scores, (n,)),
                ("moving", moving, (n,)),
            )
            if array is not None and array.shape != expected
        ]
        if not problems:
            problems += _crop_problems(self.frame_wh, origins, crops)
            if not np.isin(class_ids, [c.value for c in VehicleClass]).all():
                problems.append(f"class_ids: expected values of VehicleClass, got {sorted(set(class_ids.tolist()))}")
            if not ((scores >= 0) & (scores <= 1)).all():
                problems.append("scores: expected values in [0, 1]")
        if problems:
            raise DataError("instance masks: " + "; ".join(problems))
        fields: dict[str, Any] = {
            "origins": origins,
            "crops": crops,
            "class_ids": class_ids,
            "scores": scores,
            "moving": moving,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.crops)

    @classmethod
    def empty(cls, frame_wh: tuple[int, int]) -> InstanceMasks:
        """Return no masks for a frame of this size (width, height), px."""
        return cls.from_crops(frame_wh, [], [], [])

    @classmethod
    def from_crops(
        cls,
        frame_wh: tuple[int, int],
        crops: Sequence[Crop],
        class_ids: ArrayLike,
        scores: ArrayLike,
        *,
        are_predicted: bool = False,
    ) -> InstanceMasks:
        """Combine crops of one frame.

        Args:
            frame_wh: size of the frame, px.
            crops: N crops with their origins, see `crop_mask`.
            class_ids: (N,) values of `labelgen.labels.VehicleClass`.
            scores: (N,) in [0, 1].
            are_predicted: whether a network made them.

        Raises:
            DataError: fields that do not fit together.
        """
        return cls(
            frame_wh,
            np.array([origin for origin, _ in crops], dtype=np.int64).reshape(-1, 2),
            tuple(crop for _, crop in crops),
            np.asarray(class_ids, dtype=np.uint8),
            np.asarray(scores, dtype=np.float32),
            are_predicted,
        )

    @classmethod
    def from_masks(
        cls,
        frame_wh: tuple[int, int],
        masks: Iterable[NDArray[Any]],
        class_ids: Sequence[int],
        scores: ArrayLike,
    ) -> InstanceMasks:
        """Crop masks of the whole frame.

        Args:
            frame_wh: size of the frame, px.
            masks: N masks (H, W); any non-zero value is set, and each mask has at least one pixel set.
            class_ids: N values of `labelgen.labels.VehicleClass`.
            scores: (N,) in [0, 1].

        Raises:
            DataError: a mask without any pixel, or fields that do not fit together.
        """
        cropped = [crop_mask(mask) for mask in masks]
        if any(part is None for part in cropped):
            raise DataError("instance masks: a mask without any pixel; leave such masks out")
        return cls.from_crops(frame_wh, [part for part in cropped if part is not None], class_ids, scores)

    @property
    def boxes_xyxy(self) -> NDArray[np.int64]:
        """(N, 4) int64 bounding boxes x0, y0, x1, y1 of the crops, frame px, along pixel borders."""
        sizes = np.array([(c.shape[1], c.shape[0]) for c in self.crops], dtype=np.int64).reshape(-1, 2)
        return np.concatenate([self.origins, self.origins + sizes], axis=1)

    def inside_better(self, min_share: float) -> NDArray[np.bool_]:
        """Return (N,) which masks lie inside a mask of a higher score, to at least a share of their pixels."""
        out = np.zeros(len(self), dtype=np.bool_)
        boxes = self.boxes_xyxy
        for i, box in enumerate(boxes.tolist()):
            for j in np.flatnonzero(self.scores > self.scores[i]).tolist():
                other = boxes[j].tolist()
                low = max(box[0], other[0]), max(box[1], other[1])
                high = min(box[2], other[2]), min(box[3], other[3])
                if low[0] >= high[0] or low[1] >= high[1]:
                    continue
                own = self.crops[i][low[1] - box[1] : high[1] - box[1], low[0] - box[0] : high[0] - box[0]]
                theirs = self.crops[j][low[1] - other[1] : high[1] - other[1], low[0] - other[0] : high[0] - other[0]]
                if np.count_nonzero(own & theirs) >= min_share * np.count_nonzero(self.crops[i]):
                    out[i] = True
                    break
        return out

    def full(self, index: int) -> BoolMask:
        """Return one mask in the whole frame, (H, W) bool."""
        out = np.zeros((self.frame_wh[1], self.frame_wh[0]), dtype=np.bool_)
        (x, y), crop = self.origins[index], self.crops[index]
        out[y : y + crop.shape[0], x : x + crop.shape[1]] = crop
        return out


def crop_mask(mask: NDArray[Any], origin_px: tuple[int, int] = (0, 0)) -> Crop | None:
    """Crop a mask to the bounding box of its set pixels.

    Args:
        mask: (H, W) bool or number; any non-zero value is set.
        origin_px: frame px (x, y) of the mask's first pixel.

    Returns:
        Origin (x, y) of the crop in the frame and the crop (h, w) bool; None if no pixel is set.
    """
    image = np.ascontiguousarray(mask if mask.dtype in (np.bool_, np.uint8) else mask != 0).view(np.uint8)
    x, y, w, h = cv2.boundingRect(image)
    if w == 0:
        return None
    return (x + origin_px[0], y + origin_px[1]), image[y : y + h, x : x + w] != 0


def _crop_problems(frame_wh: tuple[int, int], origins: NDArray[np.int64], crops: tuple[BoolMask, ...]) -> list[str]:
    problems = []
    for i, ((x, y), crop) in enumerate(zip(origins.tolist(), crops, strict=True)):
        if crop.ndim != 2 or crop.dtype != np.bool_:
            problems.append(f"crops[{i}]: expected a bool array (h, w), got {crop.dtype} of shape {crop.shape}")
        elif not crop.any():
            problems.append(f"crops[{i}]: expected at least one pixel set")
        elif x < 0 or y < 0 or x + crop.shape[1] > frame_wh[0] or y + crop.shape[0] > frame_wh[1]:
            problems.append(
                f"crops[{i}]: expected it inside the frame {frame_wh[0]}x{frame_wh[1]}, "
                f"got {crop.shape[1]}x{crop.shape[0]} px at ({x}, {y})"
            )
    return problems
