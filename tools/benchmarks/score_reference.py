"""The BrnoCompSpeed protocol car by car and point by point, in the order of the public script.

It is slow. `tools.benchmarks.score` measures the vectorised protocol against it, and tests compare both scores. It is
written from the description of the protocol and shares no code with `detector.evaluation`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["score_car_by_car"]

Point = NDArray[np.float64]


def _between(point: Point, first: Point, second: Point) -> bool:
    return bool(np.dot(point, first) * np.dot(point, second) * np.dot(first[:2], second[:2]) <= 0)


def _lane(point: Point, lane_lines: Sequence[Point]) -> int | None:
    for number in range(len(lane_lines) - 1):
        if _between(point, lane_lines[number], lane_lines[number + 1]):
            return number
    return None


class _Road:
    """The road plane at offset 10, in the coordinates of the result files."""

    def __init__(self, calibration: Mapping[str, Any]) -> None:
        vp1, vp2, pp = (np.array(calibration[key], dtype=np.float64) for key in ("vp1", "vp2", "pp"))
        self.focal = math.sqrt(-np.dot(vp1 - pp, vp2 - pp))
        normal = np.cross([*(vp1 - pp), self.focal], [*(vp2 - pp), self.focal])
        normal = normal / normal[2]
        self.normal = normal / np.linalg.norm(normal)
        self.centre = np.array([*pp, 0.0])
        self.scale = calibration["scale"]

    def metres(self, first: Point, second: Point) -> float:
        return float(self.scale * np.linalg.norm(self._point(first) - self._point(second)))

    def _point(self, pixel: Point) -> Point:
        ray = np.array([pixel[0], pixel[1], self.focal]) - self.centre
        hit: Point = self.centre - (np.dot(self.normal, self.centre) + 10) / np.dot(self.normal, ray) * ray
        return hit


def _keep(car: dict[str, Any], truth: Mapping[str, Any], end_s: float) -> bool:
    """Return whether the protocol counts a car; add its points away from the border to it."""
    if not isinstance(car["posX"], list) or car["frames"][0] / truth["fps"] >= end_s:
        return False
    inside = [
        (x, y, frame)
        for x, y, frame in zip(car["posX"], car["posY"], car["frames"], strict=True)
        if 10 < x < 1910 and 10 < y < 1070
    ]
    if len(inside) <= 5:
        return False
    car["points"] = [np.array([x, y, 1.0]) for x, y, _ in inside]
    car["times"] = [frame for _, _, frame in inside]
    lanes = [_lane(point, truth["laneDivLines"]) for point in car["points"]]
    if any(lane is None or lane in truth["invalidLanes"] for lane in lanes):
        return False
    lines = truth["measurementLines"]
    return sum(_between(point, lines[0], lines[-1]) for point in car["points"]) >= 6


def _regress(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    if max(x) == min(x):
        return math.nan, math.nan
    mean_x, mean_y = np.mean(x), np.mean(y)
    slope = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / sum((a - mean_x) ** 2 for a in x)
    return float(slope), float(mean_y - slope * mean_x)


def _crossing(car: dict[str, Any], line: Point) -> tuple[Point, float]:
    """Return place (homogeneous) and frame at which a car crosses a line."""
    order = sorted(
        zip(car["points"], car["times"], strict=True),
        key=lambda item: abs(np.dot(line, item[0])) / np.linalg.norm(line[:2]),
    )[:6]
    slope, intercept = _regress([point[0] for point, _ in order], [point[1] for point, _ in order])
    fitted = np.array([slope, -1.0, intercept])
    place = np.cross(fitted, line)
    place = place / place[2]
    start = np.cross(fitted, [0.0, 1.0, 0.0])
    start = start / start[2]
    distances = []
    for point, _ in order:
        foot = np.cross(fitted, [1.0, slope, -point[0] - slope * point[1]])
        distances.append(float(np.linalg.norm(foot / foot[2] - start)))
    rate, offset = _regress(distances, [time for _, time in order]) if np.isfinite(distances).all() else (math.nan,) * 2
    return place, rate * float(np.linalg.norm(place - start)) + offset


def _measure(car: dict[str, Any], truth: Mapping[str, Any], road: _Road) -> bool:
    """Add lane, time and speed to a car; return False where they cannot be determined."""
    crossings = [_crossing(car, line) for line in truth["measurementLines"]]
    (last, last_frame), (first, first_frame) = crossings[0], crossings[-1]
    lane = _lane(last, truth["laneDivLines"])
    known = np.isfinite([*last, *first, last_frame, first_frame]).all()
    if not known or lane is None or _lane(first, truth["laneDivLines"]) is None:
        return False
    speeds = []
    for i in range(len(car["points"]) - 5):
        seconds = abs(car["times"][i] - car["times"][i + 5]) / truth["fps"]
        metres = road.metres(car["points"][i], car["points"][i + 5])
        speeds.append(metres / seconds * 3.6 if seconds else math.inf if metres else math.nan)
    car["lane"], car["last_s"], car["speed"] = lane, last_frame / truth["fps"], float(np.median(speeds))
    return math.isfinite(car["speed"])


def score_car_by_car(
    cars: Sequence[Mapping[str, Any]], truth: Mapping[str, Any], calibration: Mapping[str, Any]
) -> dict[str, Any]:
    """Score well-formed cars of a result file against the contents of a gt_data.pkl.

    Returns:
        errors (km/h, in the ground truth's order), matched, false_positives, intersection_failures.
    """
    last_times = [car["intersections"][-1]["videoTime"] for car in truth["cars"]]
    road = _Road(calibration)
    counted = [car for car in map(dict, cars) if _keep(car, truth, max(last_times))]
    with np.errstate(all="ignore"):
        measured = [car for car in counted if _measure(car, truth, road)]
    errors, matched = [], []
    for true_car, time_s in zip(truth["cars"], last_times, strict=True):
        in_lane = [car for car in measured if car["lane"] in true_car["laneIndex"]]
        in_lane.sort(key=lambda car: abs(car["last_s"] - time_s))
        if in_lane and abs(in_lane[0]["last_s"] - time_s) < 0.2:
            matched.append(in_lane[0]["id"])
            if true_car["valid"]:
                errors.append(abs(in_lane[0]["speed"] - true_car["speed"]))
    failures = len(counted) - len(measured)
    spare = [car for car in measured if min(last_times) <= car["last_s"] < max(last_times) and car["id"] not in matched]
    return {
        "errors": errors,
        "matched": len(matched),
        "false_positives": len(spare) + failures,
        "intersection_failures": failures,
    }
