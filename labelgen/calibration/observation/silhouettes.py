"""Silhouettes of what moves, gathered while a video goes by and kept as polygons: what the scale is measured on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import mask_polygon
from labelgen.geometry.homography import Array
from labelgen.masks.background.source import BackgroundMasks
from labelgen.masks.instances import InstanceMasks

__all__ = ["Blob", "BlobCollector", "mask_blobs"]

_WIDTH = 640
_PERIOD_S = 0.3
# Once so many blobs are there, nearly as many as the fits use, only every other stretch of this many seconds is looked
# at, and then every fourth. Within a stretch all looks count, for vehicles must be seen several times.
_PLENTY, _STRETCH_S = (200, 600), 4.0
# Light changes slowly.
_FOLLOW_S = 1.5
_PRIME_FRAMES = 64
_CAPACITY = 1500
_BORDER_SHARE = 0.003
# Two masks may be one vehicle where they share this much of the narrower one's width, with a gap of at most this share
# of their common height.
_SHARED_WIDTH, _GAP_SHARE = 0.6, 0.4


@dataclass(frozen=True, eq=False)
class Blob:
    """One silhouette.

    Args:
        number: of the frame.
        time_s: of the frame.
        polygon_px: (K, 2) px of the full frame, the corners of its convex hull.
        joined: whether it is several silhouettes put together; each of them is a blob, too.
    """

    number: int
    time_s: float
    polygon_px: Array
    joined: bool = False


def mask_blobs(masks: InstanceMasks, number: int, time_s: float, factor: float = 1.0) -> list[Blob]:
    """The masks of a frame as blobs, without those that the frame's border may have cut.

    A windscreen that mirrors the sky can look like the road and cut a vehicle in two, so masks one above the other are
    given together as well as alone.

    Args:
        masks: of the frame, or of a smaller copy of it.
        number, time_s: of the frame.
        factor: px of the frame per px of the masks.
    """
    width, height = masks.frame_wh
    margin = max(1.0, _BORDER_SHARE * width)
    boxes = masks.boxes_xyxy
    whole = ((boxes[:, :2] > margin) & (boxes[:, 2:] < np.array([width, height]) - margin)).all(axis=1)
    polygons = {}
    for i in np.flatnonzero(whole).tolist():
        polygon = mask_polygon(masks.crops[i], (int(boxes[i, 0]), int(boxes[i, 1])))
        if polygon is not None:
            polygons[i] = polygon
    groups = [[i] for i in polygons]
    groups += [[i, j] for i, j in combinations(polygons, 2) if _stacked(boxes[i], boxes[j])]
    return [
        Blob(number, time_s, factor * _hull(np.concatenate([polygons[i] for i in group])), joined=len(group) > 1)
        for group in groups
    ]


def _stacked(one: NDArray[np.int64], two: NDArray[np.int64]) -> bool:
    """Whether two boxes stand one above the other as the two halves of a vehicle would."""
    shared = min(one[2], two[2]) - max(one[0], two[0])
    gap = max(one[1], two[1]) - min(one[3], two[3])
    total = max(one[3], two[3]) - min(one[1], two[1])
    return bool(shared >= _SHARED_WIDTH * min(one[2] - one[0], two[2] - two[0]) and gap <= _GAP_SHARE * total)


def _hull(points: Array) -> Array:
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)


class BlobCollector:
    """Keeps a fair sample of the silhouettes in a video; a `labelgen.calibration.observation.collect.Collector`.

    It finds them with `BackgroundMasks` on small copies of a few frames per second, fewer once there are many; the
    first of them are kept until the empty scene can be learnt from them, and looked at then.

    Args:
        capacity: how many blobs to keep; later ones replace earlier ones at random.
        seed: of that choice.
    """

    def __init__(self, *, capacity: int = _CAPACITY, seed: int = 0) -> None:
        self._masks: BackgroundMasks | None = None
        self._waiting: list[tuple[int, float, NDArray[np.uint8]]] = []
        self._kept: list[Blob] = []
        self._capacity, self._rng = capacity, np.random.default_rng(seed)
        self._last_s = self._followed_s = -np.inf
        self._factor, self.seen = 1.0, 0

    def see(self, number: int, time_s: float, rgb: NDArray[np.uint8]) -> None:
        """Take in a frame."""
        if time_s < self._last_s + _PERIOD_S or not self._in_turn(time_s):
            return
        self._last_s = time_s
        height, width = rgb.shape[:2]
        self._factor = width / _WIDTH
        small = cv2.resize(rgb, (_WIDTH, max(1, round(height / self._factor))), interpolation=cv2.INTER_AREA)
        self._waiting.append((number, time_s, np.asarray(small, dtype=np.uint8)))
        if self._masks is not None or len(self._waiting) >= _PRIME_FRAMES:
            self._look()

    def blobs(self) -> list[Blob]:
        """The blobs kept so far, in order of time."""
        self._look()
        return sorted(self._kept, key=lambda blob: blob.number)

    def _look(self) -> None:
        if self._masks is None:
            self._masks = BackgroundMasks()
            self._masks.prime(image for _, _, image in self._waiting)
        for number, time_s, image in self._waiting:
            if not self._in_turn(time_s):
                continue
            if time_s >= self._followed_s + _FOLLOW_S:
                self._masks.observe(image)
                self._followed_s = time_s
            for blob in mask_blobs(self._masks.masks([image])[0], number, time_s, self._factor):
                self._keep(blob)
        self._waiting.clear()

    def _in_turn(self, time_s: float) -> bool:
        """Whether a frame of this time is looked at."""
        return int(time_s / _STRETCH_S) % (1 << sum(self.seen >= plenty for plenty in _PLENTY)) == 0

    def _keep(self, blob: Blob) -> None:
        self.seen += 1
        if len(self._kept) < self._capacity:
            self._kept.append(blob)
            return
        place = int(self._rng.integers(self.seen))
        if place < self._capacity:
            self._kept[place] = blob
