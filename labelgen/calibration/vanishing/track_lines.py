"""Feature tracks as straight lines.

Convention: normalised coordinates are (px - pp) / unit with a unit of about a focal length, so that angles between
normalised directions are nearly angles at the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.vanishing.robust import tukey_weights
from labelgen.geometry.homography import Array, homogeneous

__all__ = ["TrackLineSettings", "TrackLines", "interpretation_planes", "track_lines"]


@dataclass(frozen=True)
class TrackLineSettings:
    """How straight lines are fitted to tracks."""

    samples: int = 16
    """Points, an even number, at which a track is resampled by length: a feature at rest counts no more."""
    iterations: int = 8
    """Of the reweighted fit."""
    tukey: float = 3.0
    """Points farther off the line than this many standard deviations get no weight."""
    min_scatter_px: float = 0.25
    """Added to a track's scatter: no point is known better."""
    min_weight: float = 0.1
    """Points of at least this weight count for the length of the line."""


@dataclass(frozen=True, eq=False)
class TrackLines:
    """N tracks as straight lines, normalised.

    Args:
        centre: (N, 2).
        direction: (N, 2) unit vectors along the motion.
        length: (N,).
        scatter: (N,) robust deviation of a track's points from its line.
        halves: (N, 2, 4) centre and direction of a track's two halves, the lower one in the image first.
        time_s: (N,) middle of each track.
        pixel: one px in normalised units.
    """

    centre: Array
    direction: Array
    length: Array
    scatter: Array
    halves: Array
    time_s: Array
    pixel: float

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> TrackLines:
        return replace(
            self,
            **{
                name: getattr(self, name)[rows]
                for name in ("centre", "direction", "length", "scatter", "halves", "time_s")
            },
        )

    @property
    def planes(self) -> Array:
        """(N, 3) unit normals of the planes through the camera and each line: the homogeneous lines."""
        return interpretation_planes(self.centre, self.direction)


def track_lines(
    tracks: Sequence[Track], pp: ArrayLike, unit: float, settings: TrackLineSettings | None = None
) -> TrackLines:
    """Fit straight lines to tracks, robust against ends that leave the line.

    Args:
        tracks: N tracks.
        pp: (2,) px, principal point.
        unit: px per normalised unit.
        settings: thresholds.
    """
    settings = settings or TrackLineSettings()
    samples = settings.samples
    points = np.array([_resample_by_length(track.points_px, samples) for track in tracks]).reshape(-1, samples, 2)
    points = (points - np.asarray(pp, dtype=np.float64)) / unit
    min_scatter = settings.min_scatter_px / unit
    centre, direction, scatter, length = _robust_lines(points, min_scatter, settings)
    forward = np.sign(((points[:, -1] - points[:, 0]) * direction).sum(axis=1))
    direction *= np.where(forward == 0, 1, forward)[:, None]
    halves = []
    for part in (points[:, : samples // 2], points[:, samples // 2 :]):
        half_centre, half_direction, _, _ = _robust_lines(part, min_scatter, settings)
        halves.append(np.concatenate([half_centre, half_direction], axis=1))
    both = np.stack(halves, axis=1)
    upside_down = both[:, 0, 1] < both[:, 1, 1]
    both[upside_down] = both[upside_down][:, ::-1]
    times = np.array([(track.times_s[0] + track.times_s[-1]) / 2 for track in tracks], dtype=np.float64)
    return TrackLines(centre, direction, length, scatter, both, times, 1 / unit)


def interpretation_planes(centre: Array, direction: Array) -> Array:
    """Return the unit normals (N, 3) of the planes through the camera and lines of centre (N, 2), direction (N, 2)."""
    normals = np.cross(homogeneous(centre), np.concatenate([direction, np.zeros((len(direction), 1))], axis=1))
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _resample_by_length(points: Array, samples: int) -> Array:
    """Return points (samples, 2) at even distances along a track (K, 2)."""
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0, distance[-1], samples)
    return np.stack([np.interp(at, distance, points[:, axis]) for axis in (0, 1)], axis=1)


def _robust_lines(points: Array, min_scatter: float, settings: TrackLineSettings) -> tuple[Array, Array, Array, Array]:
    """Fit lines to point sets (N, K, 2) by Tukey's weights: centre, direction, scatter and length of each."""
    weights = np.ones(points.shape[:2])
    for _ in range(settings.iterations):
        centre = (points * weights[..., None]).sum(axis=1) / weights.sum(axis=1, keepdims=True)
        d = points - centre[:, None]
        xx, yy, xy = ((weights * p).sum(axis=1) for p in (d[..., 0] ** 2, d[..., 1] ** 2, d[..., 0] * d[..., 1]))
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        off = d[..., 1] * direction[:, :1] - d[..., 0] * direction[:, 1:]
        scatter = 1.48 * np.median(np.abs(off), axis=1, keepdims=True) + min_scatter
        weights = tukey_weights(off, settings.tukey * scatter) + 1e-6
    along = (d * direction[:, None]).sum(axis=-1)
    inlier = weights > settings.min_weight
    length = np.where(inlier, along, -np.inf).max(axis=1) - np.where(inlier, along, np.inf).min(axis=1)
    return centre, direction, scatter[:, 0], np.maximum(length, 1e-9)
