"""A made-up recording in the public files' form, in which every figure is known beforehand."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from detector.tracking.tracks import Tracks
from labelgen.datasets.brnocompspeed import GroundTruth, parse_ground_truth
from labelgen.geometry import Camera

FPS = 50.0
NEAR_M, FAR_M = 15.0, 45.0  # measurement lines: distance along the road
LANE_BORDERS_M = (3.5, 0.0, -3.5, -7.0)


@dataclass
class Traffic:
    """A camera above three lanes; cars drive towards it at constant speed."""

    camera: Camera
    truth_cars: list[dict[str, Any]] = field(default_factory=list)
    cars: list[dict[str, Any]] = field(default_factory=list)
    invalid_lanes: set[int] = field(default_factory=set)

    def line(self, ends_m: Iterable[Iterable[float]]) -> np.ndarray:
        pixels = self.camera.project(np.array(list(ends_m)))
        first, second = np.hstack([pixels, np.ones((2, 1))])
        return np.cross(first, second)

    def add_truth(self, last_s: float, speed_mps: float, lane: int | set[int], *, valid: bool = True) -> None:
        lanes = {lane} if isinstance(lane, int) else lane
        crossings = [{"measurementLineId": 1, "videoTime": last_s - (FAR_M - NEAR_M) / speed_mps}]
        crossings.append({"measurementLineId": 0, "videoTime": last_s})
        self.truth_cars.append(
            {
                "carId": len(self.truth_cars),
                "speed": speed_mps * 3.6,
                "valid": valid,
                "laneIndex": lanes,
                "intersections": crossings,
            }
        )

    def track(self, last_s: float, speed_mps: float, lane: int, name: Any = None) -> dict[str, Any]:
        """Frames in which the car is between 12 m and 50 m away, and where it is seen in them."""
        first, last = last_s - (50 - NEAR_M) / speed_mps, last_s + (NEAR_M - 12) / speed_mps
        frames = np.arange(np.ceil(first * FPS), np.floor(last * FPS) + 1)
        along = NEAR_M + speed_mps * (last_s - frames / FPS)
        pixels = self.camera.project(np.stack([along, np.full_like(along, 1.75 - 3.5 * lane)], axis=1))
        return {
            "id": len(self.cars) if name is None else name,
            "frames": frames.astype(int).tolist(),
            "posX": pixels[:, 0].tolist(),
            "posY": pixels[:, 1].tolist(),
        }

    def add_track(self, last_s: float, speed_mps: float, lane: int, name: Any = None) -> None:
        self.cars.append(self.track(last_s, speed_mps, lane, name))

    def add_both(self, last_s: float, speed_mps: float, lane: int) -> None:
        self.add_truth(last_s, speed_mps, lane)
        self.add_track(last_s, speed_mps, lane)

    def truth_data(self) -> dict[str, Any]:
        """What gt_data.pkl holds: one surveyed segment of 10 m along the road and one of 7 m across it."""
        ends = self.camera.project(np.array([[20.0, 0.0], [30.0, 0.0], [20.0, 0.0], [20.0, -7.0]]))
        points = np.hstack([ends, np.ones((4, 1))])
        return {
            "fps": FPS,
            "cars": self.truth_cars,
            "measurementLines": [self.line([[x, -9], [x, 9]]) for x in (NEAR_M, 30.0, FAR_M)],
            "laneDivLines": [self.line([[12, y], [50, y]]) for y in LANE_BORDERS_M],
            "invalidLanes": self.invalid_lanes,
            "distanceMeasurement": [
                {"p1": points[0], "p2": points[1], "distance": 10.0, "toVP1": True},
                {"p1": points[2], "p2": 2 * points[3], "distance": 7.0, "toVP1": False},
            ],
        }

    def truth(self) -> GroundTruth:
        return parse_ground_truth(self.truth_data())

    def tracks(self) -> Tracks:
        return Tracks.from_cars(self.cars)

    def results(self) -> dict[str, Any]:
        return {**self.camera.to_dict(), "cars": self.cars}

    def write(self, root: Path, recording: str, system: str) -> None:
        """As DATASET/recording/gt_data.pkl and RESULTS/recording/system_NAME.json."""
        for folder in (root / "dataset" / recording, root / "results" / recording):
            folder.mkdir(parents=True, exist_ok=True)
        # Protocol 2 is the newest that Python 2, the data set's, could write.
        with (root / "dataset" / recording / "gt_data.pkl").open("wb") as file:
            pickle.dump(self.truth_data(), file, protocol=2)
        (root / "results" / recording / f"system_{system}.json").write_text(json.dumps(self.results()))


def make_scene() -> Traffic:
    return Traffic(Camera(np.array([900.0, -350.0]), np.array([40000.0, 560.0]), np.array([960.5, 540.5]), 0.024))
