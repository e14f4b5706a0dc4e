"""Vehicles per second of the BrnoCompSpeed scoring, compared with the same protocol car by car in the same run.

    python -m tools.benchmarks.score [--dataset DIR --results DIR --system NAME] [--limit N] [--json FILE]

Without a data set it makes up traffic. Both sides start from the parsed files; the time to read them is not counted.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from detector.evaluation.brnocompspeed import score_recording
from detector.evaluation.results_folder import result_file_name, select_recordings
from detector.evaluation.summary import absolute_errors
from detector.tracking.tracks import Tracks
from labelgen.atomic_files import write_json
from labelgen.datasets.brnocompspeed import parse_ground_truth
from labelgen.datasets.safe_pickle import load_pickle
from labelgen.geometry import Camera
from tools.benchmarks.score_reference import score_car_by_car

__all__ = ["main", "measure", "synthetic_recording"]


@dataclass(frozen=True)
class Recording:
    """Parsed contents of one recording's files."""

    name: str
    truth: dict[str, Any]
    results: dict[str, Any]


def synthetic_recording(cars: int, seed: int = 0) -> Recording:
    """Make up two lanes of traffic towards the camera, 1920x1080 at 50 fps, in the form of the public files."""
    rng = np.random.default_rng(seed)
    camera = Camera(np.array([900.5, -300.0]), np.array([60000.0, 500.0]), np.array([960.5, 540.5]), 0.02)
    x_m = camera.road_points([[960.5, y] for y in (1000.0, 250.0)])[:, 0]
    truth_cars, result_cars = [], []
    starts_s = np.cumsum(rng.uniform(0.5, 1.5, cars))
    for number, start_s in enumerate(starts_s):
        lane, speed = int(rng.integers(2)), rng.uniform(50, 110)
        times = np.arange(int((x_m[1] - x_m[0]) / speed * 3.6 * 50) + 40) / 50
        along = x_m[1] + 5 - speed / 3.6 * times
        pixels = camera.project(np.stack([along, np.full_like(along, -1.75 if lane else 1.75)], axis=1))
        inside = (pixels[:, 1] > 0) & (pixels[:, 1] < 1080)
        noisy = pixels[inside] + rng.normal(0, 0.7, (np.count_nonzero(inside), 2))
        frames = np.rint((start_s + times[inside]) * 50).astype(int)
        end_s = start_s + (x_m[1] + 5 - x_m[0]) / speed * 3.6
        crossings = [{"measurementLineId": 1, "videoTime": start_s}, {"measurementLineId": 0, "videoTime": end_s}]
        truth_cars.append(
            {"carId": number, "speed": speed, "valid": True, "laneIndex": {lane}, "intersections": crossings}
        )
        position = {"posX": noisy[:, 0].tolist(), "posY": noisy[:, 1].tolist()}
        result_cars.append({"id": number, "frames": frames.tolist(), **position})
    lane_lines = [_image_line(camera, [[x_m[0], y], [x_m[1], y]]) for y in (3.5, 0.0, -3.5)]
    across = [np.array([0.0, 1.0, -y]) for y in (1000.0, 250.0)]
    truth = {"fps": 50.0, "cars": truth_cars, "measurementLines": across, "laneDivLines": lane_lines}
    truth |= {"invalidLanes": set(), "distanceMeasurement": []}
    return Recording(f"synthetic, {cars} cars", truth, {**camera.to_dict(), "cars": result_cars})


def _image_line(camera: Camera, ends_m: list[list[float]]) -> np.ndarray:
    first, second = np.hstack([camera.project(ends_m), [[1.0], [1.0]]])
    return np.cross(first, second)


def _real(dataset: Path, results: Path, system: str) -> Iterator[Recording]:
    for name in select_recordings(dataset, "all"):
        path = results / name / result_file_name(system)
        if path.is_file():
            yield Recording(name, load_pickle(dataset / name / "gt_data.pkl"), json.loads(path.read_bytes()))


def measure(recording: Recording, limit: int) -> dict[str, Any]:
    """Return the seconds that both ways take for the first `limit` cars, and whether their scores agree."""
    cars = recording.results["cars"][:limit]
    calibration = recording.results["camera_calibration"]
    truth = parse_ground_truth(recording.truth)
    camera = Camera.from_dict(recording.results)
    fast_s = np.inf
    for _ in range(5):
        begin = time.perf_counter()
        score = score_recording(truth, Tracks.from_cars(cars), camera)
        fast_s = min(fast_s, time.perf_counter() - begin)
    begin = time.perf_counter()
    slow = score_car_by_car(cars, recording.truth, calibration)
    slow_s = time.perf_counter() - begin
    agree = (
        np.count_nonzero(score.matched) == slow["matched"]
        and score.false_positives == slow["false_positives"]
        and score.intersection_failures == slow["intersection_failures"]
        and np.allclose(absolute_errors(score), slow["errors"], rtol=1e-6, atol=1e-6)
    )
    return {"recording": recording.name, "vehicles": len(cars), "fast_s": fast_s, "slow_s": slow_s, "agree": agree}


def main() -> None:
    """Measure all recordings, print the figures and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, help="folder of recordings")
    parser.add_argument("--results", type=Path, help="folder of result files")
    parser.add_argument("--system", default="blob_tracks", help="whose tracks to score")
    parser.add_argument("--limit", type=int, default=1000, help="cars of each recording (the slow side takes long)")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    if arguments.dataset and arguments.results:
        recordings = _real(arguments.dataset, arguments.results, arguments.system)
    else:
        recordings = iter([synthetic_recording(arguments.limit)])
    rows = []
    for recording in recordings:
        row = measure(recording, arguments.limit)
        rows.append(row)
        print(
            f"{row['recording']:<24} {row['vehicles']:>6} vehicles  {row['vehicles'] / row['fast_s']:>9.0f} per s, "
            f"car by car {row['vehicles'] / row['slow_s']:>6.0f} per s, ratio {row['slow_s'] / row['fast_s']:>6.0f}, "
            f"{'same result' if row['agree'] else 'RESULTS DIFFER'}"
        )
    fast, slow = (sum(row[key] for row in rows) for key in ("fast_s", "slow_s"))
    print(f"altogether: {sum(row['vehicles'] for row in rows) / fast:.0f} vehicles per s, ratio {slow / fast:.0f}")
    if arguments.json:
        write_json(arguments.json, {"rows": rows, "ratio": slow / fast})


if __name__ == "__main__":
    main()
