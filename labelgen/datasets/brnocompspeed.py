"""Ground truth of a BrnoCompSpeed recording: speeds, lanes, measurement lines and surveyed distances.

Source: Sochor et al., "Comprehensive Data Set for Automatic Single Camera Visual Speed Measurement", IEEE T-ITS 2018.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import DataError
from labelgen.geometry.homography import Array

__all__ = ["GroundTruth", "parse_ground_truth", "read_ground_truth"]

_MAX_LINES = 1000


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """G cars, measurement lines, lanes and surveyed segments of one recording.

    Convention: a homogeneous line (a, b, c) holds the frame points (x, y) with a x + b y + c = 0.

    Args:
        fps: frames per second of the video.
        speeds_kmh: (G,) true speeds.
        valid: (G,) whether the car is scored.
        last_times_s: (G,) time in the video at which the car crossed its last measurement line, s.
        in_lane: (G, L - 1) whether the car drove in that lane.
        measurement_lines: (M, 3) homogeneous lines, M >= 2; the first one is crossed last.
        lane_lines: (L, 3) homogeneous lines, the borders of the L - 1 lanes, L >= 2.
        invalid_lanes: numbers of the lanes that are not scored.
        segments_px: (S, 2, 2) end points (x, y) of surveyed segments, frame px.
        segments_m: (S,) lengths of the surveyed segments.
    """

    fps: float
    speeds_kmh: Array
    valid: NDArray[np.bool_]
    last_times_s: Array
    in_lane: NDArray[np.bool_]
    measurement_lines: Array
    lane_lines: Array
    invalid_lanes: frozenset[int]
    segments_px: Array
    segments_m: Array

    def __len__(self) -> int:
        return len(self.speeds_kmh)


def read_ground_truth(path: str | Path) -> GroundTruth:
    """Read a `gt_data.pkl`.

    Raises:
        DataError: the file is missing, refused, or not of the data set's layout.
    """
    data = load_pickle(path)
    try:
        return parse_ground_truth(data)
    except DataError as err:
        raise DataError(f"ground truth {path}: {err}") from None


def parse_ground_truth(data: Any) -> GroundTruth:
    """Convert the contents of a `gt_data.pkl`.

    Args:
        data: what `labelgen.datasets.safe_pickle.load_pickle` returns for the file.

    Raises:
        DataError: the contents are not of the data set's layout.
    """
    try:
        return _parse(data)
    except KeyError as err:
        raise DataError(f"key {err} is missing; is this a BrnoCompSpeed gt_data.pkl?") from None
    except (AttributeError, IndexError, TypeError, ValueError, OverflowError, RecursionError) as err:
        raise DataError(f"not of the BrnoCompSpeed layout ({err})") from None


def _parse(data: Any) -> GroundTruth:
    if not isinstance(data, Mapping):
        raise DataError("expected a dict")
    cars = list(data["cars"])
    if not cars:
        raise DataError("there are no cars in it, so there is nothing to score against")
    for number, car in enumerate(cars):
        if not len(car["intersections"]):
            raise DataError(f"car {car.get('carId', number)} crosses no measurement line")
    lanes = _lines(data["laneDivLines"], "laneDivLines")
    if len(lanes) > _MAX_LINES:
        raise DataError(f"laneDivLines: {len(lanes)} lines are more than any road has")
    in_lane = np.zeros((len(cars), len(lanes) - 1), dtype=np.bool_)
    for row, car in zip(in_lane, cars, strict=True):
        row[[lane for lane in _lane_numbers(car["laneIndex"]) if 0 <= lane < len(row)]] = True
    segments = list(data.get("distanceMeasurement", ()))
    ends = np.array([[s["p1"], s["p2"]] for s in segments], dtype=np.float64).reshape(-1, 2, 3)
    truth = GroundTruth(
        fps=float(data["fps"]),
        speeds_kmh=np.array([car["speed"] for car in cars], dtype=np.float64),
        valid=np.array([bool(car["valid"]) for car in cars]),
        last_times_s=np.array([car["intersections"][-1]["videoTime"] for car in cars], dtype=np.float64),
        in_lane=in_lane,
        measurement_lines=_lines(data["measurementLines"], "measurementLines"),
        lane_lines=lanes,
        invalid_lanes=frozenset(_lane_numbers(data.get("invalidLanes", ()))),
        segments_px=ends[..., :2] / ends[..., 2:],
        segments_m=np.array([s["distance"] for s in segments], dtype=np.float64),
    )
    _check(truth)
    return truth


def _lane_numbers(value: Any) -> list[int]:
    return [int(lane) for lane in value] if isinstance(value, Iterable) else [int(value)]


def _lines(value: Any, name: str) -> Array:
    lines = np.array(list(value), dtype=np.float64)
    if lines.ndim != 2 or lines.shape[1] != 3 or len(lines) < 2:
        raise DataError(f"{name}: expected at least two lines of three numbers, got shape {lines.shape}")
    if not np.isfinite(lines).all() or not lines[:, :2].any(axis=1).all():
        raise DataError(f"{name}: a line is not finite or has no direction")
    return lines


def _check(truth: GroundTruth) -> None:
    problems = []
    if not (np.isfinite(truth.fps) and truth.fps > 0):
        problems.append(f"fps: expected a positive number, got {truth.fps}")
    if not (np.isfinite(truth.speeds_kmh) & (truth.speeds_kmh > 0))[truth.valid].all():
        problems.append("speed: expected positive numbers for valid cars")
    if not np.isfinite(truth.last_times_s).all():
        problems.append("videoTime: expected finite numbers")
    if not (np.isfinite(truth.segments_m) & (truth.segments_m > 0)).all():
        problems.append("distanceMeasurement: expected positive distances")
    if not np.isfinite(truth.segments_px).all():
        problems.append("distanceMeasurement: expected finite points")
    if problems:
        raise DataError("; ".join(problems))
