"""Masks of moving vehicles seen by a fixed camera, without any weights: a background model and clean-up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.geometry.road_mask import binary_mask
from labelgen.labels import VehicleClass
from labelgen.masks.background.model import BackgroundModel
from labelgen.masks.background.silhouettes import Silhouette, find_silhouettes
from labelgen.masks.instances import InstanceMasks, crop_mask

__all__ = ["WORKING_WIDTH", "BackgroundMasks"]

# All frames are worked on at this width: the clean-up works in pixels, and silhouettes gain nothing from more. What
# would become lower or higher than this is stretched to it: slivers have no silhouettes, but must not fill the memory.
WORKING_WIDTH = 640
_WORKING_HEIGHTS = (16, 2560)
# A vehicle stands on the lowest part of its silhouette, of this share of its height.
_FOOT_SHARE = 0.2
_FOOT_MARGIN_SHARE = 0.01


class BackgroundMasks:
    """Silhouettes of what differs from the empty scene; all of class VEHICLE.

    The score is the share of a silhouette's pixels that differ from the scene: the rest was filled in.

    Args:
        road_mask: (H, W[, C]) of the frame's size, thresholded at half range; vehicles must stand on it.
        score_threshold: silhouettes with a lower score are left out.

    Raises:
        DataError: a frame of another size than the road mask.
    """

    name = "background"
    every_frame = 5
    prime_frames = 3000
    batch_size = 1

    def __init__(self, *, road_mask: NDArray[Any] | None = None, score_threshold: float = 0.5) -> None:
        self.problems: list[str] = []
        self._road = None if road_mask is None else binary_mask(road_mask)
        self._score_threshold = score_threshold
        self._model = BackgroundModel()
        self._feet: NDArray[np.bool_] | None = None

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Learn the empty scene from the beginning of the video, best from a minute or more of it."""
        self._model.prime(self._small(frame) for frame in frames)

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Follow the scene's light by one frame (H, W, 3) uint8 BGR."""
        self._model.observe(self._small(image))

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """The silhouettes in each frame against the scene as observed so far; see `MaskSource.masks`."""
        return [self._masks_of(image) for image in images]

    def _small(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        h, w = image.shape[:2]
        if self._road is not None and self._road.shape != (h, w):
            raise DataError(
                f"road mask: it is {self._road.shape[1]}x{self._road.shape[0]} px, but the frames are {w}x{h}; "
                "give a mask of the frame's size"
            )
        low, high = _WORKING_HEIGHTS
        size = (WORKING_WIDTH, min(max(low, round(h * WORKING_WIDTH / w)), high))
        if size == (w, h):
            return image
        how = cv2.INTER_AREA if w > WORKING_WIDTH else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(image, size, interpolation=how), dtype=np.uint8)

    def _masks_of(self, image: NDArray[np.uint8]) -> InstanceMasks:
        frame_wh = (image.shape[1], image.shape[0])
        small = self._small(image)
        if self._model.background is None:
            return InstanceMasks.empty(frame_wh)
        aligned, shift = self._model.align(small)
        origins, crops, scores = [], [], []
        for silhouette in find_silhouettes(aligned, self._model):
            if silhouette.score < self._score_threshold:
                continue
            part = _to_frame(silhouette, shift, (small.shape[1], small.shape[0]), frame_wh)
            if part is None or not self._stands_on_road(*part):
                continue
            origins.append(part[0])
            crops.append(part[1])
            scores.append(silhouette.score)
        return InstanceMasks(
            frame_wh,
            np.array(origins, dtype=np.int64).reshape(-1, 2),
            tuple(crops),
            np.full(len(crops), VehicleClass.VEHICLE, dtype=np.uint8),
            np.array(scores, dtype=np.float32),
        )

    def _stands_on_road(self, origin: tuple[int, int], crop: NDArray[np.bool_]) -> bool:
        if self._road is None:
            return True
        if self._feet is None:
            # The near border of a mask is rarely drawn along the tyres.
            size = 2 * round(_FOOT_MARGIN_SHARE * self._road.shape[1]) + 1
            self._feet = cv2.dilate(self._road.view(np.uint8), np.ones((size, size), np.uint8)) > 0
        h = crop.shape[0]
        top = h - max(1, round(_FOOT_SHARE * h))
        rows, columns = np.nonzero(crop[top:])
        return bool(self._feet[origin[1] + top + int(rows.mean()), origin[0] + int(np.median(columns))])


def _to_frame(
    silhouette: Silhouette, shift: tuple[int, int], small_wh: tuple[int, int], frame_wh: tuple[int, int]
) -> tuple[tuple[int, int], NDArray[np.bool_]] | None:
    """Origin and crop in the frame of a silhouette found in a shrunken and shifted one."""
    x, y = (o - s for o, s in zip(silhouette.origin, shift, strict=True))
    h, w = silhouette.crop.shape
    cut = silhouette.crop[max(0, -y) : small_wh[1] - y, max(0, -x) : small_wh[0] - x]
    x, y = max(0, x), max(0, y)
    if cut.size == 0:
        return None
    if small_wh == frame_wh:
        return crop_mask(cut, (x, y))
    fx, fy = frame_wh[0] / small_wh[0], frame_wh[1] / small_wh[1]
    low = (int(x * fx), int(y * fy))
    high = (min(frame_wh[0], int(np.ceil((x + w) * fx))), min(frame_wh[1], int(np.ceil((y + h) * fy))))
    matrix = np.array([[fx, 0, x * fx - low[0] + fx / 2 - 0.5], [0, fy, y * fy - low[1] + fy / 2 - 0.5]])
    size = (high[0] - low[0], high[1] - low[1])
    padded = cv2.warpAffine(cut.astype(np.uint8) * 255, matrix, size, flags=cv2.INTER_LINEAR, borderValue=0)
    at_border = cv2.warpAffine(
        cut.astype(np.uint8) * 255, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    # A vehicle cut by the frame reaches its border.
    for axis, (start, stop, limit) in enumerate(zip(low, high, frame_wh, strict=True)):
        for side, touches in ((0, start == 0), (-1, stop == limit)):
            if touches:
                edge = (side, slice(None)) if axis == 1 else (slice(None), side)
                padded[edge] = at_border[edge]
    return crop_mask(padded >= 128, low)
