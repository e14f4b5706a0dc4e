"""The road as the part of the frame in which things move along VP1.

Dense optical flow between frames a fraction of a second apart is counted, pixel by pixel, by its direction; the
vanishing points need not be known for that. With VP1, what moved towards it or away from it is kept, cleaned, and
made straight: strips between lines to VP1, from the farthest motion seen down to the frame's border. The part near the
horizon is cut off: it could not be rectified.

The mask therefore holds what vehicles on the road cover, up to their roofs, not their tyres' tracks alone; that is
what masks drawn by hand for this purpose hold too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibrate.scale import unit_camera
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera
from labelgen.geometry.projective import Array

__all__ = ["FlowCollector", "RoadMaskEstimate", "road_mask"]

_WIDTH = 320
_PERIOD_S, _LONGEST_GAP_S = 0.25, 0.6
_BINS = 24
_CHANGED_LEVELS, _SAME_LEVELS = 12, 20
_SLOWEST_PX = 0.7
# Motion within this angle of the line to VP1 runs along it, and most of a pixel's motion must.
_ALONG_DEG, _ALONG_SHARE = 20.0, 0.5
_FEWEST_VISITS, _VISIT_SHARE = 2, 0.05
_SMALLEST_SHARE, _PIECE_SHARE = 0.01, 0.15
_HORIZON_MARGIN = 0.06
_CLOSE_SHARE = 0.03
# The road ends where this share of its support lies nearer. Of the strips along it those count that are supported over
# this share of what the best ones are.
_FAR_PERCENTILE, _STRIPS, _STRIP_SHARE, _BEST_STRIPS = 99.5, 160, 0.3, 0.9

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RoadMaskEstimate:
    """A road mask and how well it is supported.

    Args:
        pixels: (H, W) bool.
        moves: how many pairs of frames showed motion along VP1.
        along: share of all motion seen that ran along VP1.
    """

    pixels: Mask
    moves: int
    along: float


class FlowCollector:
    """Rides on the pass over a video (`labelgen.calibrate.observe.Collector`) and counts directions of motion.

    Attributes:
        size_wh: px of the frames; None before the first.
        counts: (h, w, B) uint16, how often a pixel of the small frame moved into each of B directions, from that of x
            towards that of y.
        pairs: pairs of frames in which something moved.
    """

    def __init__(self) -> None:
        self.size_wh: tuple[int, int] | None = None
        self.counts: NDArray[np.uint16] = np.zeros((0, 0, _BINS), dtype=np.uint16)
        self.pairs = 0
        self._before: NDArray[np.uint8] | None = None
        self._before_s = self._last_s = -np.inf

    def see(
        self, number: int, time_s: float, rgb: NDArray[np.uint8], moving: NDArray[np.bool_] | NDArray[np.uint8] | None
    ) -> None:
        """Take in a frame; what moves is found by the difference to the one before."""
        height, width = rgb.shape[:2]
        size = (_WIDTH, max(1, round(height * _WIDTH / width)))
        small = cv2.cvtColor(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        now = np.asarray(small, dtype=np.uint8)
        if self.size_wh is None:
            self.size_wh = (width, height)
            self.counts = np.zeros((*now.shape, _BINS), dtype=np.uint16)
        before, gap = self._before, time_s - self._before_s
        self._before, self._before_s = now, time_s
        if before is not None and 0 < gap <= _LONGEST_GAP_S and time_s >= self._last_s + _PERIOD_S:
            self._last_s = time_s
            self._count(before, now)

    def _count(self, before: NDArray[np.uint8], now: NDArray[np.uint8]) -> None:
        changed = cv2.blur(cv2.absdiff(before, now), (3, 3)) > _CHANGED_LEVELS
        x, y, w, h = cv2.boundingRect(changed.view(np.uint8))
        if w < 4 or h < 4:
            return
        here = np.s_[max(0, y - 8) : y + h + 8, max(0, x - 8) : x + w + 8]
        start = np.zeros((*before[here].shape, 2), dtype=np.float32)
        flow = np.asarray(cv2.calcOpticalFlowFarneback(before[here], now[here], start, 0.5, 4, 15, 2, 5, 1.1, 0))
        rows, columns = np.indices(flow.shape[:2], dtype=np.float32)
        # A flow that ends on something of another brightness is none.
        found = cv2.remap(now[here], columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR)
        sound = (cv2.absdiff(found, before[here]) < _SAME_LEVELS) & changed[here]
        sound &= np.hypot(flow[..., 0], flow[..., 1]) > _SLOWEST_PX
        if not sound.any():
            return
        turn = np.arctan2(flow[..., 1], flow[..., 0])[sound]
        bins = np.floor(turn * (_BINS / (2 * np.pi))).astype(np.int64) % _BINS
        row, column = np.nonzero(sound)
        self.counts[row + here[0].start, column + here[1].start, bins] += 1
        self.pairs += 1


def road_mask(camera: Camera, flow: FlowCollector) -> RoadMaskEstimate:
    """The road in a video.

    Args:
        camera: VP1 and the horizon count; it needs no scale.
        flow: has seen the video.

    Raises:
        CalibrationError: nothing, or too little, moves along VP1.
    """
    if flow.size_wh is None:
        raise CalibrationError("road mask: the video showed no frame; use another part of it")
    if camera.image_wh is not None and tuple(camera.image_wh) != flow.size_wh:
        raise CalibrationError(
            f"road mask: the calibration is for {camera.image_wh[0]}x{camera.image_wh[1]} px, but the frames are "
            f"{flow.size_wh[0]}x{flow.size_wh[1]}; calibrate with frames of this size"
        )
    small = camera.resized(_WIDTH / flow.size_wh[0])
    ways = _along(small, flow.counts)
    total = flow.counts.sum(axis=2, dtype=np.int64)
    along = ways.sum(axis=0)
    often = max(_FEWEST_VISITS, _VISIT_SHARE * float(np.percentile(along[along > 0], 90)) if along.any() else 0)
    support = (along >= often) & (along >= _ALONG_SHARE * total) & _below_horizon(small, total.shape)
    pixels = _straight(small, _closed(support), ways[0] - ways[1])
    share = float(ways.sum() / max(1, total.sum()))
    if pixels.mean() < _SMALLEST_SHARE:
        seen = "nothing moves" if not total.any() else "too little moves"
        raise CalibrationError(
            f"road mask: {seen} along VP1 ({share:.0%} of the motion seen); use a part of the "
            "video with traffic, or check the calibration"
        )
    levels = cv2.resize(pixels.astype(np.uint8) * 255, flow.size_wh, interpolation=cv2.INTER_LINEAR)
    return RoadMaskEstimate(np.asarray(levels >= 128, dtype=np.bool_), flow.pairs, share)


def _along(small: Camera, counts: NDArray[np.uint16]) -> Array:
    """(2, h, w) how often each pixel moved towards VP1, and away from it."""
    height, width = counts.shape[:2]
    towards = small.vp1 - _middles((height, width))
    turn = np.arctan2(towards[..., 1], towards[..., 0])
    bins = (np.arange(_BINS) + 0.5) * (2 * np.pi / _BINS)
    cosine = np.cos(bins - turn[..., None])
    limit = np.cos(np.radians(_ALONG_DEG))
    return np.stack([np.where(way * cosine > limit, counts, 0).sum(axis=2, dtype=np.float64) for way in (1, -1)])


def _middles(shape: tuple[int, ...]) -> Array:
    """(h, w, 2) px, the pixels' middles."""
    return np.stack(np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5), axis=-1)


def _below_horizon(small: Camera, shape: tuple[int, ...]) -> Mask:
    """(h, w) the pixels well below the line that joins VP1 and VP2."""
    # The horizon is where the third coordinate of a pixel's ray, an affine function of the pixel, is 0.
    origin, right, down = small.rays(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))[:, 2]
    depth = -small.rays(_middles(shape))[..., 2] / np.hypot(right - origin, down - origin)
    return np.asarray(depth > _HORIZON_MARGIN * shape[0])


def _closed(support: Mask) -> Mask:
    """Support without specks and without small holes; its larger parts."""
    size = max(3, int(_CLOSE_SHARE * support.shape[1])) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    clean = cv2.morphologyEx(support.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    clean = cv2.morphologyEx(np.pad(clean, size), cv2.MORPH_CLOSE, disc)[size:-size, size:-size]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(clean))
    areas = stats[1:, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(areas >= _PIECE_SHARE * areas.max()) if count > 1 else []
    return np.isin(labels, large)


def _straight(small: Camera, support: Mask, towards: Array) -> Mask:
    """Support made straight: strips between lines to VP1, from a line across the road down to the frame's border.

    A strip counts where much of it, from the far end of what is supported to the near one, is supported; all from the
    first to the last of one direction of travel is one carriageway, and it goes on to the frame's border, which fast
    vehicles reach in too few frames to be seen often.

    Args:
        small: camera of the small frame.
        support: (h, w).
        towards: (h, w) how much more often a pixel moved towards VP1 than away from it.
    """
    if not support.any():
        return support
    below = _below_horizon(small, support.shape)
    ground = unit_camera(small).road_points(_middles(support.shape), invalid="nan")
    far = float(np.percentile(ground[support][:, 0], _FAR_PERCENTILE))
    road = below & (ground[..., 0] <= far)
    # On the road a line to VP1 is a line of one Y.
    across = np.where(road, ground[..., 1], np.nan)
    edges = np.linspace(*np.nanquantile(across[support & road], [0, 1]), _STRIPS + 1)
    seen, _ = np.histogram(across[support & road], edges)
    every, _ = np.histogram(across[road], edges)
    share = seen / np.maximum(every, 1)
    is_road = share >= _STRIP_SHARE * np.quantile(share, _BEST_STRIPS)
    # Near the camera motion may be too fast to tell its direction, so what is far away decides.
    weights = (towards * ground[..., 0])[support & road]
    way = np.histogram(across[support & road], edges, weights=weights)[0] >= 0
    out = np.zeros(support.shape, dtype=np.bool_)
    for same in (way, ~way):
        strips = np.flatnonzero(is_road & same)
        if len(strips):
            with np.errstate(invalid="ignore"):
                out |= (across >= edges[strips[0]]) & (across <= edges[strips[-1] + 1])
    return out
