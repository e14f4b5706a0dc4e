"""Real sessions as scenes: their camera, lanes, road mask and picture, and their recorded traffic.

A replayed car drives down the middle of its lane and crosses each measurement line at the recorded time. Between and
beyond the lines it keeps its speed. Its true speed is what the session's calibration makes of these crossings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.brnocompspeed import parse_ground_truth
from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.geometry.road_mask import binary_mask
from labelgen.media.image_file import read_image
from labelgen.synth.fitting.lighting import fit_to_road
from labelgen.synth.scene.scene import FARTHEST_M, Lane, RoadScene, road_to_image
from labelgen.synth.scene.traffic import Trip, near_path_x
from labelgen.synth.shading.lighting import Light, Weather, make_light
from labelgen.synth.vehicle.vehicle import body_kinds, vehicle_size

__all__ = ["load_scene", "replayed_traffic"]

_LEAD_S = 2.0
"""Seconds before the first recorded crossing at which a replay begins: enough for the first car to drive into view."""
_CALIBRATION = "system_optimal_calibration.json"


def load_scene(folder: Path, weather: Weather, rng: np.random.Generator) -> tuple[RoadScene, Light, dict[str, Any]]:
    """Open a real session, `ROOT/dataset/NAME`, with its calibration in `ROOT/results/NAME`.

    Args:
        folder: holds gt_data.pkl, video_mask.png and screen.png.
        weather: kind of light; its brightness and tint are fitted to the picture's road.
        rng: decides on the sun.

    Returns:
        The scene, its light, and the content of gt_data.pkl.

    Raises:
        DataError: a file is missing or damaged.
    """
    folder = Path(folder)
    name = folder.resolve().name
    calibration = folder.resolve().parent.parent / "results" / name / _CALIBRATION
    background, mask = _picture(folder / "screen.png"), binary_mask(_picture(folder / "video_mask.png"))
    if mask.shape != background.shape[:2]:
        raise DataError(f"{folder}: video_mask.png and screen.png differ in size; get them from the data set again")
    camera = Camera.load(calibration, image_wh=(background.shape[1], background.shape[0]))
    camera = replace(camera, name=name)
    gt = load_pickle(folder / "gt_data.pkl")
    if not isinstance(gt, dict):
        raise DataError(f"{folder / 'gt_data.pkl'}: not a BrnoCompSpeed ground truth; get it from the data set again")
    missing = {"cars", "measurementLines", "laneDivLines", "invalidLanes", "distanceMeasurement"} - set(gt)
    if missing:
        raise DataError(
            f"{folder / 'gt_data.pkl'}: no {', '.join(sorted(missing))} in it; get it from the data set again"
        )
    try:
        parse_ground_truth(gt)
    except DataError as err:
        raise DataError(f"{folder / 'gt_data.pkl'}: {err}; get it from the data set again") from None
    lane_lines = tuple(np.asarray(line, dtype=np.float64) for line in gt["laneDivLines"])
    lines = tuple(np.asarray(line, dtype=np.float64) for line in gt["measurementLines"])
    light = fit_to_road(make_light(weather, rng), background, mask)
    scene = RoadScene(name, camera, (), lane_lines, lines, mask, background, _x_range(camera, mask))
    return replace(scene, lanes=_lanes(scene, gt)), light, gt


def _picture(path: Path) -> NDArray[np.uint8]:
    if not path.exists():
        raise DataError(
            f"{path}: no such picture; a session folder holds screen.png and video_mask.png", parameter="scene"
        )
    return read_image(path)


def _x_range(camera: Camera, mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the range of X that is driven, metres: from behind the frame's near border to beyond the marked road."""
    rows, columns = np.nonzero(mask)
    pick = slice(None, None, max(1, len(rows) // 20000))
    x = camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")[:, 0]
    return -25.0, float(min(np.nanmax(x) + 60.0, FARTHEST_M))


def _lanes(scene: RoadScene, gt: dict[str, Any]) -> tuple[Lane, ...]:
    """Return the measured lanes: straight lines midway between their borders at the first and last line."""
    to_road = np.linalg.inv(road_to_image(scene.camera))
    heading = _heading(scene, gt)
    lanes = []
    for index, (a, b) in enumerate(zip(scene.lane_lines[:-1], scene.lane_lines[1:], strict=True)):
        middles = []
        for line in (scene.measurement_lines[0], scene.measurement_lines[-1]):
            corners = np.stack([np.cross(border, line) for border in (a, b)]) @ to_road.T
            middles.append((corners[:, :2] / corners[:, 2:]).mean(axis=0))
        (x0, y0), (x1, y1) = middles
        slope = float((y1 - y0) / (x1 - x0))
        speeds = [c["speed"] for c in gt["cars"] if index in c["laneIndex"] and c["valid"]]
        lanes.append(Lane(float(y0 - slope * x0), slope, heading, float(np.median(speeds)) if speeds else 80.0, index))
    return tuple(lanes)


def _heading(scene: RoadScene, gt: dict[str, Any]) -> int:
    """Return +1 for traffic that drives away, -1 for traffic that comes closer: the first line is crossed last."""
    to_road = np.linalg.inv(road_to_image(scene.camera))
    x = []
    for line in (scene.measurement_lines[0], scene.measurement_lines[-1]):
        corner = to_road @ np.cross(scene.lane_lines[0], line)
        x.append(corner[0] / corner[2])
    return 1 if x[0] > x[1] else -1


def replayed_traffic(
    scene: RoadScene, gt: dict[str, Any], duration_s: float, seed: int, *,
    start_s: float | None = None, kinds: Sequence[str] | None = None,
) -> list[Trip]:  # fmt: skip
    """Return the recorded cars of a part of a session as trips; times count from the start of the part.

    Args:
        scene: from `load_scene`.
        gt: content of gt_data.pkl, from `load_scene`.
        duration_s: length of the part.
        seed: decides what the vehicles look like.
        start_s: where the part begins; shortly before the first crossing when None.
        kinds: body types to choose from.

    Raises:
        DataError: no crossing was recorded in that part.
    """
    first = min((i["videoTime"] for c in gt["cars"] for i in c["intersections"]), default=0.0)
    start = max(0.0, float(first) - _LEAD_S) if start_s is None else start_s
    trips = []
    # Numbers of cars repeat in some recordings, so tracks are numbered by their place in the file.
    for number, car in enumerate(gt["cars"], start=1):
        times = {int(i["measurementLineId"]): float(i["videoTime"]) - start for i in car["intersections"]}
        lane_index = min(car["laneIndex"], default=None)
        if not times or lane_index is None or not -20 < max(times.values()) < duration_s + 20:
            continue
        lane = next((lane for lane in scene.lanes if lane.index == lane_index), None)
        if lane is not None:
            trips.append(_trip(scene, lane, number, int(car["carId"]), times, seed))
    if not any(0 <= t < duration_s for trip in trips for t in trip.knots_s):
        raise DataError(
            f"{scene.name}: no crossing was recorded between {start:.0f} and {start + duration_s:.0f} s; "
            "begin elsewhere",
            parameter="start_s",
        )
    trips.sort(key=lambda trip: (trip.lane.index or 0, trip.knots_s[-1]))
    return _with_bodies(trips, seed, kinds)


def _trip(scene: RoadScene, lane: Lane, number: int, car_id: int, times: dict[int, float], seed: int) -> Trip:
    knots = sorted((time, near_path_x(scene, scene.measurement_lines[k], lane, 0.0)) for k, time in times.items())
    if len(knots) == 1:
        # One crossing gives no speed: take the lane's usual one.
        time, x = knots[0]
        knots.append((time + 1.0, x + lane.heading * lane.speed_kmh / 3.6))
    t, x = np.array(knots).T
    return Trip(number, "", (seed, 31, number), lane, np.zeros(3), t, x, 0.0, car_id)


def _with_bodies(trips: list[Trip], seed: int, kinds: Sequence[str] | None) -> list[Trip]:
    """Give each car a body that fits the gap to the next one of its lane."""
    out = []
    for k, trip in enumerate(trips):
        rng = np.random.default_rng([seed, 32, trip.track_id])
        gaps = [
            abs(other.near_x(trip.knots_s[-1]) - trip.knots_x[-1])
            for other in trips[max(0, k - 1) : k + 2]
            if other is not trip and other.lane is trip.lane
        ]
        names, shares = body_kinds(max(4.0, min(gaps, default=100.0) - 4.0))
        kind = str(rng.choice(list(kinds))) if kinds else str(rng.choice(names, p=shares))
        size = vehicle_size(kind, np.random.default_rng(list(trip.vehicle_seed)))
        out.append(replace(trip, kind=kind, size_lwh=size))
    return out
