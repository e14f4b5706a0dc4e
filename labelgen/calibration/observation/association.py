"""Which silhouettes are of one vehicle: those that hold features of it while these are followed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.observation.silhouettes import Blob

__all__ = ["choose_sightings", "vehicle_of_blobs"]

# Of the features in a silhouette so many must be of one vehicle.
_AGREE = 0.6


def vehicle_of_blobs(blobs: Sequence[Blob], tracks: Sequence[Track], vehicles: NDArray[np.int64]) -> NDArray[np.int64]:
    """(B,) number of the vehicle that each blob is of; -1 where no feature, or no one vehicle's features, tell.

    Args:
        blobs: B of them; those joined from several are of no vehicle.
        tracks: N features.
        vehicles: (N,) number of each track's vehicle.
    """
    alone = [i for i, blob in enumerate(blobs) if not blob.joined]
    times = np.array([blobs[i].time_s for i in alone])
    order = np.argsort(times, kind="stable")
    times, alone = times[order], [alone[k] for k in order.tolist()]
    outlines = [blobs[i].polygon_px.astype(np.float32) for i in alone]
    low = np.array([p.min(axis=0) for p in outlines]).reshape(-1, 2)
    high = np.array([p.max(axis=0) for p in outlines]).reshape(-1, 2)
    votes: list[dict[int, int]] = [{} for _ in alone]
    for track, vehicle in zip(tracks, vehicles.tolist(), strict=True):
        first, last = np.searchsorted(times, [track.times_s[0], np.nextafter(track.times_s[-1], np.inf)])
        at = np.stack([np.interp(times[first:last], track.times_s, track.points_px[:, k]) for k in (0, 1)], axis=1)
        near = ((at >= low[first:last]) & (at <= high[first:last])).all(axis=1)
        for k in np.flatnonzero(near).tolist():
            if cv2.pointPolygonTest(outlines[first + k], (float(at[k, 0]), float(at[k, 1])), False) >= 0:
                votes[first + k][vehicle] = votes[first + k].get(vehicle, 0) + 1
    out = np.full(len(blobs), -1, dtype=np.int64)
    for i, found in zip(alone, votes, strict=True):
        if found:
            most = max(found, key=lambda vehicle: (found[vehicle], -vehicle))
            if found[most] >= _AGREE * sum(found.values()):
                out[i] = most
    return out


def choose_sightings(
    blobs: Sequence[Blob], vehicles: NDArray[np.int64], *, least_px: float, most: int
) -> NDArray[np.int64]:
    """Numbers of the blobs worth comparing: of vehicles seen at least twice, those first that change their size most.

    Args:
        blobs: B of them.
        vehicles: (B,) as from `vehicle_of_blobs`.
        least_px: blobs with a smaller square root of the area do not count.
        most: about how many to choose.
    """
    sizes = np.array([np.sqrt(cv2.contourArea(b.polygon_px.astype(np.float32))) for b in blobs])
    of: dict[int, dict[int, int]] = {}
    for i in np.flatnonzero((vehicles >= 0) & (sizes >= least_px)).tolist():
        # Of several parts of a vehicle in one frame the largest counts.
        frames = of.setdefault(int(vehicles[i]), {})
        other = frames.get(blobs[i].number)
        if other is None or sizes[i] > sizes[other]:
            frames[blobs[i].number] = i
    seen = [np.array(list(frames.values())) for frames in of.values() if len(frames) > 1]
    seen.sort(key=lambda rows: sizes[rows].min() / sizes[rows].max())
    counts = np.cumsum([len(rows) for rows in seen])
    kept = seen[: int(np.searchsorted(counts, most)) + 1]
    return np.concatenate([*kept, np.empty(0, dtype=np.int64)])
