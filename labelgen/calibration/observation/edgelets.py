"""Edgelets: short straight edges on what moves, with directions good to a fraction of a degree.

Published work fits a direction to the gradients of a small window. Longer straight edges (bumpers, number plates, the
borders of windscreens and roofs) give it several times more accurately. Edges are therefore grown as line segments over
as many pixels as share a direction, at the video's full resolution.

Source: Sochor et al., "Traffic surveillance camera calibration by 3D model bounding box alignment", CVIU 2017, section
3.1 (edgelets for VP2); von Gioi et al., "LSD", IPOL 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = ["EdgeletFinder", "EdgeletSettings"]


@dataclass(frozen=True)
class EdgeletSettings:
    """Which line segments become edgelets."""

    min_length_share: float = 0.005
    """Shortest edgelet as a share of the frame's width; shorter ones are more, and their directions less accurate."""
    min_length_px: float = 7.0
    """Shortest edgelet in px of the full frame, for small videos."""
    dilation_px: int = 3
    """Odd size, px of the shrunken frame, by which moving pixels are widened: edges lie at the border of motion."""
    zone_dilation_px: int = 9
    """Odd size, px of the shrunken frame, that joins moving pixels into zones; larger zones cost more time."""
    zone_erosion_px: int = 5
    """Odd size, px of the shrunken frame, by which the joined zones shrink again."""
    max_zones: int = 12
    """Largest zones of a frame that are searched; more cost time and add distant vehicles."""
    min_zone_px: int = 24
    """Zones with a shorter side, px of the full frame, are not searched: edges there are too short."""
    min_moving_share: float = 0.6
    """Least share of an edge's probes on moving pixels; lower values let edges of the background in."""
    probes: int = 9
    """Points along an edge at which motion is looked up."""
    probe_margin: float = 0.1
    """Share of the edge's length that is left out at each end: end points may lie beside the motion."""
    max_edgelets: int = 40000
    """Above this number every second edgelet is dropped, and from then on every second frame is skipped: memory."""


class EdgeletFinder:
    """Gather straight edges from where consecutive frames differ.

    Args:
        size_wh: px of the full frames.
        factor: full-frame px per px of the shrunken frames on which motion is detected.
        settings: thresholds.

    Attributes:
        count: number of edgelets so far.
    """

    def __init__(self, size_wh: tuple[int, int], factor: int, settings: EdgeletSettings | None = None) -> None:
        self._settings = settings or EdgeletSettings()
        self._factor = factor
        self._min_length = max(self._settings.min_length_px, self._settings.min_length_share * size_wh[0])
        margin = self._settings.probe_margin
        self._probes = np.linspace(margin, 1 - margin, self._settings.probes)
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE)
        self._edgelets: list[Array] = []
        self.count = self._calls = 0
        self._every = 1

    def update(self, grey: NDArray[np.uint8], moving: NDArray[np.uint8], time_s: float) -> None:
        """Take a frame.

        Args:
            grey: (H, W) uint8, full size.
            moving: (h, w) uint8, 1 where the shrunken frame changes.
            time_s: of the frame, seconds.
        """
        self._calls += 1
        if self._calls % self._every:
            return
        near = _dilate(moving, self._settings.dilation_px)
        erosion = np.ones((self._settings.zone_erosion_px,) * 2, np.uint8)
        blocks = cv2.morphologyEx(_dilate(near, self._settings.zone_dilation_px), cv2.MORPH_ERODE, erosion)
        _, _, stats, _ = cv2.connectedComponentsWithStats(blocks)
        zones = sorted(stats[1:].tolist(), key=lambda zone: -zone[4])[: self._settings.max_zones]
        for x, y, w, h, _ in zones:
            left, top, right, bottom = (k * self._factor for k in (x, y, x + w, y + h))
            if min(right - left, bottom - top) < self._settings.min_zone_px:
                continue
            self._add_zone(grey[top:bottom, left:right], (left, top), near, time_s)
        if self.count > self._settings.max_edgelets:
            self._edgelets = [np.concatenate(self._edgelets)[::2]]
            self.count = len(self._edgelets[0])
            self._every *= 2

    @property
    def edgelets(self) -> Array:
        """(N, 5) end points x0, y0, x1, y1 in px of the full frame (pixels as areas), and time in seconds."""
        return np.concatenate(self._edgelets) if self._edgelets else np.empty((0, 5))

    def _add_zone(
        self, part: NDArray[np.uint8], origin: tuple[int, int], near: NDArray[np.uint8], time_s: float
    ) -> None:
        segments = self._detector.detect(np.ascontiguousarray(part))[0]
        if segments is None:
            return
        ends = segments.reshape(-1, 2, 2).astype(np.float64) + origin + 0.5
        vectors = ends[:, 1] - ends[:, 0]
        ends, vectors = (a[np.hypot(*vectors.T) >= self._min_length] for a in (ends, vectors))
        probes = ends[:, :1] + vectors[:, None] * self._probes[:, None]
        at = np.clip((probes / self._factor).astype(np.int64), 0, np.array(near.shape[::-1]) - 1)
        ends = ends[near[at[..., 1], at[..., 0]].mean(axis=1) >= self._settings.min_moving_share]
        if len(ends):
            self._edgelets.append(np.concatenate([ends.reshape(-1, 4), np.full((len(ends), 1), time_s)], axis=1))
            self.count += len(ends)


def _dilate(mask: NDArray[np.uint8], size_px: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate(mask, np.ones((size_px, size_px), np.uint8)), dtype=np.uint8)
