"""Dense traffic of real vehicles: tracks of the BrnoCompSpeed data set, repaired and moved together in time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import Camera
from labelgen.labeling.fitted.passages import Sightings

Track = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]
"""Frames (F,), places (F, 2) metres, metres per px (F, 2)."""


def read_tracks(file: Path) -> list[Track]:
    """Return the tracks of a result file that show one vehicle moving well inside the frame, one track a vehicle."""
    data = json.loads(file.read_text())
    camera = Camera.from_dict(data)
    tracks = []
    # The tracker holds vehicles at its lower border until they have gone.
    lowest = max(max(car["posY"]) for car in data["cars"] if isinstance(car["posY"], list)) - 60
    for car in data["cars"]:
        frames, points = np.array(car["frames"]), np.stack([car["posX"], car["posY"]], axis=-1)
        if frames.ndim != 1 or points.ndim != 2:
            continue
        inside = ((points > 20) & (points < [1900, lowest])).all(axis=1)
        frames, points = frames[inside], points[inside]
        if len(frames) < 40 or np.ptp(frames) != len(frames) - 1:
            continue
        places = camera.road_points(points, invalid="nan")
        steps = [camera.road_points(points + step) - camera.road_points(points - step) for step in ([0, 0.5], [0.5, 0])]
        if np.isfinite(places).all() and abs(places[-1, 0] - places[0, 0]) > 8:
            tracks.append((frames, places, np.abs(steps).max(axis=0)))
    return _one_each(tracks)


def gather(
    tracks: list[Track], fps: float, every_frame: int, seconds: float, headway_s: float, seed: int
) -> tuple[Sightings, NDArray[np.int64]]:
    """Return sightings of tracks set into a short time, at least a headway apart in a lane, and their vehicles (N,)."""
    rng = np.random.default_rng(seed)
    length = int(seconds * fps)
    lanes: list[Track] = []
    for number in rng.permutation(len(tracks)).tolist():
        frames, places, scale = tracks[number]
        gap_m = max(8.0, headway_s * fps * abs(places[-1, 0] - places[0, 0]) / len(frames))
        for _ in range(3):
            moved = frames - frames[0] + int(rng.integers(length))
            if all(_apart((moved, places, scale), other, gap_m) for other in lanes):
                lanes.append((moved, places, scale))
                break
    rows = []
    for vehicle, (frames, places, scale) in enumerate(lanes):
        taken = frames % every_frame == 0
        width = rng.uniform(1.6, 1.9)
        for frame, place, step in zip(frames[taken], places[taken], scale[taken], strict=True):
            rows.append((frame, *place, *step, width, vehicle))
    table = np.array(sorted(rows))
    n, size = len(table), table[:, 5] * np.exp(rng.normal(0, 0.08, len(table)))
    frames, zeros = table[:, 0].astype(np.int64), np.zeros(n, dtype=np.int64)
    sightings = Sightings(
        frames / fps, frames, table[:, 1:3], size, size * 0.9, zeros, zeros > 0, table[:, 3:5], every_frame
    )
    return sightings, table[:, 6].astype(np.int64)


def _apart(track: Track, other: Track, gap_m: float) -> bool:
    """Return whether two vehicles, going on at their last speeds for a second, keep a distance in a lane."""
    if track[0][0] > other[0][-1] + 50 or other[0][0] > track[0][-1] + 50:
        return True
    times = np.arange(max(track[0][0], other[0][0]) - 50, min(track[0][-1], other[0][-1]) + 51, 5)
    apart = np.abs(_at(track, times) - _at(other, times))
    return not ((apart[:, 0] < gap_m) & (apart[:, 1] < 1.5)).any()


def _at(track: Track, times: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the places (T, 2) of a vehicle, extrapolated beyond its track."""
    frames, places, _ = track
    inside = np.stack([np.interp(times, frames, places[:, k]) for k in (0, 1)], axis=-1)
    low, high = (places[20] - places[0]) / 20, (places[-1] - places[-21]) / 20
    before, after = np.minimum(times - frames[0], 0), np.maximum(times - frames[-1], 0)
    return np.asarray(inside + before[:, None] * low + after[:, None] * high)


def _one_each(tracks: list[Track]) -> list[Track]:
    """Leave out the tracks near which a longer one runs: a tracker often has several of one vehicle."""
    out: list[Track] = []
    for track in sorted(tracks, key=lambda track: -len(track[0])):
        if all(_apart(track, other, 6.0) for other in out):
            out.append(track)
    return out
