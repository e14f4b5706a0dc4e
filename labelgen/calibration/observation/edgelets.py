"""Edgelets: short straight edges on what moves, with directions good to a fraction of a degree.

Published work fits a direction to the gradients of a small window. Longer straight edges (bumpers, number plates, the
borders of windscreens and roofs) tell it several times better, so edges are grown as line segments over as many pixels
as share a direction, at the video's full resolution.

Source: Sochor et al., "Traffic surveillance camera calibration by 3D model bounding box alignment", CVIU 2017, section
3.1 (edgelets for VP2); von Gioi et al., "LSD", IPOL 2012.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = ["EdgeletFinder"]

_SHORTEST_SHARE = 0.005
_SHORTEST_PX = 7.0
_MOST_ZONES = 12
_LEAST_ZONE_PX = 24
# An edge belongs to something that moves if at least this share of it lies where the picture changes.
_ON_MOVING = 0.6
_PROBES = np.linspace(0.1, 0.9, 9)


class EdgeletFinder:
    """Gathers straight edges from where consecutive frames differ.

    Args:
        size_wh: px of the full frames.
        factor: by how much the frames were shrunk on which motion was seen.
        most: how many edges are kept; from then on ever fewer of the new ones are taken.

    Attributes:
        count: of the edges so far.
    """

    def __init__(self, size_wh: tuple[int, int], factor: int, *, most: int = 40000) -> None:
        self._size_wh, self._factor, self._most = size_wh, factor, most
        self._shortest = max(_SHORTEST_PX, _SHORTEST_SHARE * size_wh[0])
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE)
        self._found: list[Array] = []
        self.count = self._calls = 0
        self._every = 1

    def see(self, grey: NDArray[np.uint8], moving: NDArray[np.uint8], time_s: float) -> None:
        """Take a frame.

        Args:
            grey: (H, W) uint8, full size.
            moving: (h, w) uint8, 1 where the picture changes, on the shrunken frame.
            time_s: of the frame.
        """
        self._calls += 1
        if self._calls % self._every:
            return
        near = np.asarray(cv2.dilate(moving, np.ones((3, 3), np.uint8)), dtype=np.uint8)
        blocks = cv2.morphologyEx(
            cv2.dilate(near, np.ones((9, 9), np.uint8)), cv2.MORPH_ERODE, np.ones((5, 5), np.uint8)
        )
        _, _, stats, _ = cv2.connectedComponentsWithStats(blocks)
        zones = sorted(stats[1:].tolist(), key=lambda zone: -zone[4])[:_MOST_ZONES]
        for x, y, w, h, _ in zones:
            left, top, right, bottom = (k * self._factor for k in (x, y, x + w, y + h))
            if min(right - left, bottom - top) < _LEAST_ZONE_PX:
                continue
            self._zone(grey[top:bottom, left:right], (left, top), near, time_s)
        if self.count > self._most:
            self._found = [np.concatenate(self._found)[::2]]
            self.count = len(self._found[0])
            self._every *= 2

    @property
    def edgelets(self) -> Array:
        """(N, 5) end points x0, y0, x1, y1 in px of the full frame, pixels as areas, and time, s."""
        return np.concatenate(self._found) if self._found else np.empty((0, 5))

    def _zone(self, part: NDArray[np.uint8], origin: tuple[int, int], near: NDArray[np.uint8], time_s: float) -> None:
        segments = self._detector.detect(np.ascontiguousarray(part))[0]
        if segments is None:
            return
        ends = segments.reshape(-1, 2, 2).astype(np.float64) + origin + 0.5
        way = ends[:, 1] - ends[:, 0]
        ends, way = (a[np.hypot(*way.T) >= self._shortest] for a in (ends, way))
        probes = ends[:, :1] + way[:, None] * _PROBES[:, None]
        at = np.clip((probes / self._factor).astype(np.int64), 0, np.array(near.shape[::-1]) - 1)
        ends = ends[near[at[..., 1], at[..., 0]].mean(axis=1) >= _ON_MOVING]
        if len(ends):
            self._found.append(np.concatenate([ends.reshape(-1, 4), np.full((len(ends), 1), time_s)], axis=1))
            self.count += len(ends)
