"""Masks of moving vehicles of a fixed camera by background subtraction; no network weights are needed."""

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
from labelgen.masks.instances import Crop, InstanceMasks, crop_mask

__all__ = ["WORKING_WIDTH", "BackgroundMasks"]

WORKING_WIDTH = 640
"""Width to which all frames are resized, px: the thresholds are in px, and a larger width improves no silhouette."""
# Heights beyond these limits are resized to them, so that extreme aspect ratios do not fill the memory.
_WORKING_HEIGHTS = (16, 2560)
# The contact point of a vehicle lies in the lowest part of its silhouette, of this share of its height.
_CONTACT_SHARE = 0.2
# The road mask is dilated by this share of its width: its near border is rarely drawn along the tyres.
_ROAD_MARGIN_SHARE = 0.01


class BackgroundMasks:
    """A `labelgen.masks.source.MaskSource`: silhouettes of what differs from the empty scene, all of class VEHICLE.

    The score is the share of a silhouette's pixels that differ from the empty scene; the others were filled in.

    Args:
        road_mask: (H, W[, C]) of the frame's size, thresholded at half range; contact points must lie on it. None
            keeps all silhouettes.
        score_threshold: silhouettes with a lower score are left out.
    """

    every_frame = 5
    prime_frames = 3000
    batch_size = 1

    def __init__(self, *, road_mask: NDArray[Any] | None = None, score_threshold: float = 0.5) -> None:
        self.problems: list[str] = []
        self._road = None if road_mask is None else binary_mask(road_mask)
        self._score_threshold = score_threshold
        self._model = BackgroundModel()
        self._dilated_road: NDArray[np.bool_] | None = None

    def prime(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Learn the empty scene from the beginning of a video, a minute or more; see `MaskSource.prime`.

        Raises:
            DataError: a frame is not of the road mask's size.
        """
        self._model.prime(self._resize(frame) for frame in frames)

    def observe(self, image: NDArray[np.uint8]) -> None:
        """Update the empty scene with one frame; see `MaskSource.observe`.

        Raises:
            DataError: the frame is not of the road mask's size.
        """
        self._model.observe(self._resize(image))

    def masks(
        self,
        images: Sequence[NDArray[np.uint8]],
        frame_numbers: Sequence[int] | None = None,
        file_names: Sequence[str] | None = None,
    ) -> list[InstanceMasks]:
        """Return the silhouettes in each image; see `MaskSource.masks`.

        Raises:
            DataError: an image is not of the road mask's size.
        """
        return [self._masks_of(image) for image in images]

    def _resize(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
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
        interpolation = cv2.INTER_AREA if w > WORKING_WIDTH else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(image, size, interpolation=interpolation), dtype=np.uint8)

    def _masks_of(self, image: NDArray[np.uint8]) -> InstanceMasks:
        frame_wh = (image.shape[1], image.shape[0])
        small = self._resize(image)
        if self._model.background is None:
            return InstanceMasks.empty(frame_wh)
        aligned, shift = self._model.align(small)
        crops, scores = [], []
        for silhouette in find_silhouettes(aligned, self._model):
            if silhouette.score < self._score_threshold:
                continue
            crop = _to_frame(silhouette, shift, (small.shape[1], small.shape[0]), frame_wh)
            if crop is None or not self._is_on_road(*crop):
                continue
            crops.append(crop)
            scores.append(silhouette.score)
        return InstanceMasks.from_crops(frame_wh, crops, [VehicleClass.VEHICLE] * len(crops), scores)

    def _is_on_road(self, origin: tuple[int, int], crop: NDArray[np.bool_]) -> bool:
        if self._road is None:
            return True
        if self._dilated_road is None:
            size = 2 * round(_ROAD_MARGIN_SHARE * self._road.shape[1]) + 1
            self._dilated_road = cv2.dilate(self._road.view(np.uint8), np.ones((size, size), np.uint8)) > 0
        h = crop.shape[0]
        top = h - max(1, round(_CONTACT_SHARE * h))
        rows, columns = np.nonzero(crop[top:])
        return bool(self._dilated_road[origin[1] + top + int(rows.mean()), origin[0] + int(np.median(columns))])


def _to_frame(
    silhouette: Silhouette, shift: tuple[int, int], small_wh: tuple[int, int], frame_wh: tuple[int, int]
) -> Crop | None:
    """Map a silhouette of a resized and shifted image to the frame; None where it lies outside."""
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
    # The silhouette of a vehicle that the frame cuts reaches the frame's border.
    for axis, (start, stop, limit) in enumerate(zip(low, high, frame_wh, strict=True)):
        for side, touches in ((0, start == 0), (-1, stop == limit)):
            if touches:
                edge = (side, slice(None)) if axis == 1 else (slice(None), side)
                padded[edge] = at_border[edge]
    return crop_mask(padded >= 128, low)
