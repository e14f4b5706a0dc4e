"""Which silhouettes are of one vehicle: those that hold tracked features of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.observation.silhouettes import VehicleSilhouette

__all__ = ["AssociationSettings", "associate_silhouettes", "select_silhouettes"]


@dataclass(frozen=True)
class AssociationSettings:
    """How silhouettes are assigned to vehicles, and which of them are used."""

    min_agreement: float = 0.6
    """Least share of the features in a silhouette that must be of one vehicle; lower values accept merged vehicles."""
    min_size_share: float = 0.02
    """Smallest silhouette: square root of its area as a share of the frame's width; below it outlines are coarse."""
    max_count: int = 300
    """About how many silhouettes are used; more cost time."""


def associate_silhouettes(
    silhouettes: Sequence[VehicleSilhouette],
    tracks: Sequence[Track],
    vehicles: NDArray[np.int64],
    settings: AssociationSettings | None = None,
) -> NDArray[np.int64]:
    """Return each silhouette's vehicle (S,); -1 where no feature, or no one vehicle's features, decide.

    Args:
        silhouettes: S of them; joined ones are of no vehicle.
        tracks: N features.
        vehicles: (N,) number of each track's vehicle.
        settings: thresholds.
    """
    settings = settings or AssociationSettings()
    single = [i for i, silhouette in enumerate(silhouettes) if not silhouette.joined]
    times = np.array([silhouettes[i].time_s for i in single])
    order = np.argsort(times, kind="stable")
    times, single = times[order], [single[k] for k in order.tolist()]
    outlines = [silhouettes[i].polygon_px.astype(np.float32) for i in single]
    low = np.array([p.min(axis=0) for p in outlines]).reshape(-1, 2)
    high = np.array([p.max(axis=0) for p in outlines]).reshape(-1, 2)
    votes: list[dict[int, int]] = [{} for _ in single]
    for track, vehicle in zip(tracks, vehicles.tolist(), strict=True):
        first, last = np.searchsorted(times, [track.times_s[0], np.nextafter(track.times_s[-1], np.inf)])
        at = np.stack([np.interp(times[first:last], track.times_s, track.points_px[:, k]) for k in (0, 1)], axis=1)
        in_box = ((at >= low[first:last]) & (at <= high[first:last])).all(axis=1)
        for k in np.flatnonzero(in_box).tolist():
            if cv2.pointPolygonTest(outlines[first + k], (float(at[k, 0]), float(at[k, 1])), False) >= 0:
                votes[first + k][vehicle] = votes[first + k].get(vehicle, 0) + 1
    out = np.full(len(silhouettes), -1, dtype=np.int64)
    for i, counts in zip(single, votes, strict=True):
        if counts:
            best = max(counts, key=lambda vehicle: (counts[vehicle], -vehicle))
            if counts[best] >= settings.min_agreement * sum(counts.values()):
                out[i] = best
    return out


def select_silhouettes(
    silhouettes: Sequence[VehicleSilhouette], vehicles: NDArray[np.int64], *, min_size_px: float, max_count: int
) -> NDArray[np.int64]:
    """Return the numbers (K,) of silhouettes worth comparing.

    Those are of vehicles seen at least twice; the vehicles whose size changes most come first.

    Args:
        silhouettes: S of them.
        vehicles: (S,) as from `associate_silhouettes`.
        min_size_px: silhouettes with a smaller square root of the area do not count.
        max_count: about how many to select.
    """
    sizes = np.array([np.sqrt(cv2.contourArea(s.polygon_px.astype(np.float32))) for s in silhouettes])
    by_vehicle: dict[int, dict[int, int]] = {}
    for i in np.flatnonzero((vehicles >= 0) & (sizes >= min_size_px)).tolist():
        # Of several parts of a vehicle in one frame the largest counts.
        by_frame = by_vehicle.setdefault(int(vehicles[i]), {})
        other = by_frame.get(silhouettes[i].frame_number)
        if other is None or sizes[i] > sizes[other]:
            by_frame[silhouettes[i].frame_number] = i
    groups = [np.array(list(by_frame.values())) for by_frame in by_vehicle.values() if len(by_frame) > 1]
    groups.sort(key=lambda rows: sizes[rows].min() / sizes[rows].max())
    counts = np.cumsum([len(rows) for rows in groups])
    selected = groups[: int(np.searchsorted(counts, max_count)) + 1]
    return np.concatenate([*selected, np.empty(0, dtype=np.int64)])
