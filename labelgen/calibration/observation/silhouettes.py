"""Silhouettes of vehicles, sampled during the pass over a video and kept as convex hulls."""

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

__all__ = ["SilhouetteCollector", "SilhouetteSettings", "VehicleSilhouette", "silhouettes_from_masks"]


@dataclass(frozen=True)
class SilhouetteSettings:
    """Which silhouettes are gathered."""

    working_width_px: int = 640
    """Width of the copies on which masks are made; larger ones cost time and give finer outlines."""
    interval_s: float = 0.3
    """Least time between two frames that are used."""
    sparse_from: tuple[int, ...] = (200, 600)
    """Numbers of silhouettes from which on half and then a quarter of the stretches are used. The fits use about 300:
    more of them cost time alone."""
    stretch_s: float = 4.0
    """Length of these stretches; within one all sampled frames count, for a vehicle must be seen several times."""
    background_interval_s: float = 1.5
    """Time between two updates of the background model; light changes slowly."""
    prime_frames: int = 64
    """Frames from which the background model is first estimated; fewer leave vehicles in it."""
    capacity: int = 1500
    """Silhouettes kept; later ones replace earlier ones at random."""
    border_share: float = 0.003
    """A mask nearer to the border, as a share of the frame's width, may be cut off and is left out."""
    min_shared_width: float = 0.6
    """Two masks are joined where they share this much of the narrower one's width."""
    max_gap_share: float = 0.4
    """Largest gap between joined masks, as a share of their common height."""


@dataclass(frozen=True, eq=False)
class VehicleSilhouette:
    """One silhouette in one frame.

    Args:
        frame_number: of the frame.
        time_s: of the frame, seconds.
        polygon_px: (K, 2) px of the full frame, the corners of its convex hull.
        joined: whether it is two masks put together; each of these is a silhouette of its own too.
    """

    frame_number: int
    time_s: float
    polygon_px: Array
    joined: bool = False


def silhouettes_from_masks(
    masks: InstanceMasks,
    frame_number: int,
    time_s: float,
    factor: float = 1.0,
    settings: SilhouetteSettings | None = None,
) -> list[VehicleSilhouette]:
    """Return the silhouettes of a frame's masks, without those that the frame's border may have cut.

    A windscreen that mirrors the sky can look like the road and cut a vehicle in two. Masks one above the other are
    therefore given joined as well as alone.

    Args:
        masks: of the frame, or of a smaller copy of it.
        frame_number, time_s: of the frame.
        factor: px of the frame per px of the masks.
        settings: thresholds.
    """
    settings = settings or SilhouetteSettings()
    width, height = masks.frame_wh
    margin = max(1.0, settings.border_share * width)
    boxes = masks.boxes_xyxy
    whole = ((boxes[:, :2] > margin) & (boxes[:, 2:] < np.array([width, height]) - margin)).all(axis=1)
    polygons = {}
    for i in np.flatnonzero(whole).tolist():
        polygon = mask_polygon(masks.crops[i], (int(boxes[i, 0]), int(boxes[i, 1])))
        if polygon is not None:
            polygons[i] = polygon
    groups = [[i] for i in polygons]
    groups += [[i, j] for i, j in combinations(polygons, 2) if _stacked(boxes[i], boxes[j], settings)]
    return [
        VehicleSilhouette(
            frame_number, time_s, factor * _hull(np.concatenate([polygons[i] for i in group])), joined=len(group) > 1
        )
        for group in groups
    ]


def _stacked(one: NDArray[np.int64], two: NDArray[np.int64], settings: SilhouetteSettings) -> bool:
    """Return whether two boxes (4,) xyxy stand one above the other as the two halves of a vehicle would."""
    shared = min(one[2], two[2]) - max(one[0], two[0])
    gap = max(one[1], two[1]) - min(one[3], two[3])
    total = max(one[3], two[3]) - min(one[1], two[1])
    narrower = min(one[2] - one[0], two[2] - two[0])
    return bool(shared >= settings.min_shared_width * narrower and gap <= settings.max_gap_share * total)


def _hull(points: Array) -> Array:
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)


class SilhouetteCollector:
    """Keep a random sample of the silhouettes in a video, all with the same chance.

    Masks are made by `BackgroundMasks` on small copies of a few frames per second, fewer once there are many. The first
    frames wait until the background model can be estimated from them.

    Args:
        settings: thresholds.
        seed: of the sampling.

    Attributes:
        count: number of silhouettes so far, kept or not.
    """

    def __init__(self, settings: SilhouetteSettings | None = None, *, seed: int = 0) -> None:
        self._settings = settings or SilhouetteSettings()
        self._masks: BackgroundMasks | None = None
        self._waiting: list[tuple[int, float, NDArray[np.uint8]]] = []
        self._sample: list[VehicleSilhouette] = []
        self._rng = np.random.default_rng(seed)
        self._last_s = self._background_s = -np.inf
        self._factor, self.count = 1.0, 0

    def update(self, frame_number: int, time_s: float, rgb: NDArray[np.uint8]) -> None:
        """Take a frame, (H, W, 3) uint8 RGB of full size, in order of time."""
        settings = self._settings
        if time_s < self._last_s + settings.interval_s or not self._in_used_stretch(time_s):
            return
        self._last_s = time_s
        height, width = rgb.shape[:2]
        self._factor = width / settings.working_width_px
        small_wh = settings.working_width_px, max(1, round(height / self._factor))
        small = cv2.resize(rgb, small_wh, interpolation=cv2.INTER_AREA)
        self._waiting.append((frame_number, time_s, np.asarray(small, dtype=np.uint8)))
        if self._masks is not None or len(self._waiting) >= settings.prime_frames:
            self._process_waiting()

    def silhouettes(self) -> list[VehicleSilhouette]:
        """Return the sample so far, in order of time."""
        self._process_waiting()
        return sorted(self._sample, key=lambda silhouette: silhouette.frame_number)

    def _process_waiting(self) -> None:
        settings = self._settings
        if self._masks is None:
            self._masks = BackgroundMasks()
            self._masks.prime(image for _, _, image in self._waiting)
        for number, time_s, image in self._waiting:
            if not self._in_used_stretch(time_s):
                continue
            if time_s >= self._background_s + settings.background_interval_s:
                self._masks.observe(image)
                self._background_s = time_s
            masks = self._masks.masks([image])[0]
            for silhouette in silhouettes_from_masks(masks, number, time_s, self._factor, settings):
                self._add(silhouette)
        self._waiting.clear()

    def _in_used_stretch(self, time_s: float) -> bool:
        """Return whether a frame of this time is used."""
        period = 1 << sum(self.count >= limit for limit in self._settings.sparse_from)
        return int(time_s / self._settings.stretch_s) % period == 0

    def _add(self, silhouette: VehicleSilhouette) -> None:
        """Reservoir sampling: keep the silhouette, or replace an earlier one by it at random."""
        self.count += 1
        if len(self._sample) < self._settings.capacity:
            self._sample.append(silhouette)
            return
        place = int(self._rng.integers(self.count))
        if place < self._settings.capacity:
            self._sample[place] = silhouette
