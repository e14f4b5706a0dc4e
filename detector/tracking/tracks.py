"""Tracks of vehicles, as the public result files hold them.

A result file is `{"camera_calibration": {...}, "cars": [{"id", "frames", "posX", "posY"}, ...]}`. In some published
files the positions of a car are single numbers in place of lists, and some cars have other keys (`contours`) as well.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.tracking.per_track import track_numbers
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array, IntArray
from labelgen.json_file import read_json

__all__ = ["ResultFile", "Tracks", "read_results"]


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracks of N vehicles with P points altogether.

    Args:
        points_px: (P, 2) frame px, one track after the other.
        frames: (P,) frame numbers as in the file; they need not be sorted.
        offsets: (N + 1,) first row of each track, and P.
        ids: (N,) names of the tracks as in the file; they need not be unique.
        dropped: number of cars that were left out so far, by reason.
    """

    points_px: Array
    frames: Array
    offsets: IntArray
    ids: tuple[Hashable, ...]
    dropped: Counter[str] = field(default_factory=Counter)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def track_numbers(self) -> IntArray:
        """(P,) number of the track that each point belongs to."""
        return track_numbers(self.offsets)

    @property
    def lengths(self) -> IntArray:
        """(N,) number of points per track."""
        return np.diff(self.offsets)

    def count(self, points: NDArray[np.bool_]) -> IntArray:
        """Return (N,) how many points of each track are True in `points` (P,)."""
        return np.bincount(self.track_numbers[points], minlength=len(self))

    def keep_points(self, keep: NDArray[np.bool_]) -> Tracks:
        """Return the same tracks with the points that are True in `keep` (P,); a track may become empty."""
        offsets = np.concatenate([[0], np.cumsum(self.count(keep))])
        return Tracks(self.points_px[keep], self.frames[keep], offsets, self.ids, self.dropped)

    def keep_tracks(self, keep: NDArray[np.bool_], reason: str) -> Tracks:
        """Return the tracks that are True in `keep` (N,); the others are counted as dropped for `reason`."""
        removed = int(np.count_nonzero(~keep))
        if not removed:
            return self
        rows = keep[self.track_numbers]
        return Tracks(
            self.points_px[rows],
            self.frames[rows],
            np.concatenate([[0], np.cumsum(self.lengths[keep])]),
            tuple(name for name, keep_it in zip(self.ids, keep, strict=True) if keep_it),
            self.dropped + Counter({reason: removed}),
        )

    @classmethod
    def from_cars(cls, cars: list[Any]) -> Tracks:
        """Make tracks from the `cars` of a result file; cars without usable lists are dropped and counted.

        Args:
            cars: as JSON holds them, each with "posX", "posY" and "frames".
        """
        xs, ys, frames, ids = [], [], [], []
        dropped: Counter[str] = Counter()
        for number, car in enumerate(cars):
            parts = _car_arrays(car)
            if isinstance(parts, str):
                dropped[parts] += 1
                continue
            xs.append(parts[0])
            ys.append(parts[1])
            frames.append(parts[2])
            # Cars without an id get distinct ones, so that they are not taken for the same car.
            name = car.get("id")
            ids.append(name if isinstance(name, int | float | str) else ("car", number))
        offsets = np.concatenate([[0], np.cumsum([len(part) for part in frames], dtype=np.int64)])
        empty = np.empty(0)
        points = np.stack([np.concatenate([*xs, empty]), np.concatenate([*ys, empty])], axis=1)
        return cls(points, np.concatenate([*frames, empty]), offsets, tuple(ids), dropped)


def _car_arrays(car: Any) -> tuple[Array, Array, Array] | str:
    """Return posX, posY and frames of one car, or the reason why it is dropped."""
    if not isinstance(car, Mapping):
        return "not an object"
    arrays = []
    for key in ("posX", "posY", "frames"):
        value = car.get(key)
        if not isinstance(value, list):
            return "without lists"
        try:
            array = np.array(value) if value else np.empty(0)
        except ValueError:
            return "not numbers"
        if array.ndim != 1 or array.dtype.kind not in "iuf":
            return "not numbers"
        arrays.append(array.astype(np.float64, copy=False))
    x, y, frames = arrays
    if not len(x) == len(y) == len(frames):
        return "lists of different lengths"
    if not len(x):
        return "without points"
    if not np.isfinite(frames).all():
        return "not numbers"
    return x, y, frames


@dataclass(frozen=True, eq=False)
class ResultFile:
    """Contents of one result file.

    Args:
        path: of the file.
        tracks: of its cars.
        calibration: `camera_calibration` as in the file; None where there is none.
    """

    path: Path
    tracks: Tracks
    calibration: Any

    def camera(self) -> Camera:
        """Return the calibration of the file.

        Raises:
            CalibrationError: there is none in the file, or it describes no camera.
        """
        return Camera.from_dict({"camera_calibration": self.calibration}, name=str(self.path))

    def lane_scales(self) -> Any:
        """Return `lane_scales` of the calibration as in the file, one factor per lane; three ones by default."""
        calibration = self.calibration if isinstance(self.calibration, Mapping) else {}
        return calibration.get("lane_scales", [1.0, 1.0, 1.0])


def read_results(path: str | Path) -> ResultFile:
    """Read a result file of the public format.

    Args:
        path: of the file.

    Raises:
        DataError: no such file, not JSON, or no list `cars` in it.
    """
    path = Path(path)
    if not path.exists():
        raise DataError(f"results {path}: no such file; check its folder and the name of the system")
    data = read_json(path, f"results {path}")
    cars = data.get("cars") if isinstance(data, dict) else None
    if not isinstance(cars, list):
        raise DataError(f"results {path}: expected an object with a list 'cars', as in the public result files")
    return ResultFile(path, Tracks.from_cars(cars), data.get("camera_calibration"))
