"""Which silhouettes are of one vehicle, and which of them are used."""

from __future__ import annotations

import numpy as np
import pytest

from labelgen.calibration.observation.association import associate_silhouettes, select_silhouettes
from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.observation.silhouettes import VehicleSilhouette


def square(number: int, x: float, y: float, half: float, *, joined: bool = False) -> VehicleSilhouette:
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) + np.array([x, y])
    return VehicleSilhouette(number, number / 10, corners, joined=joined)


def line(x0: float, x1: float, y: float = 100.0) -> Track:
    return Track(np.array([0.0, 1.0]), np.array([[x0, y], [x1, y]]))


@pytest.mark.parametrize(
    ("tracks", "vehicles", "expected"),
    [
        ([line(100, 200)], [3], 3),
        ([line(100, 200), line(105, 205), line(95, 195)], [3, 3, 4], 3),
        ([line(100, 200), line(105, 205)], [3, 4], -1),
        ([line(300, 400)], [3], -1),
        ([Track(np.array([0.6, 1.0]), np.array([[150.0, 100.0], [150.0, 100.0]]))], [3], -1),
        ([], [], -1),
    ],
    ids=["one feature", "most of them", "no majority", "elsewhere", "later", "no features"],
)
def test_silhouettes_go_to_the_vehicle_of_their_features(tracks, vehicles, expected):
    silhouettes = [square(5, 150, 100, 20), square(5, 150, 100, 20, joined=True)]
    assert associate_silhouettes(silhouettes, tracks, np.array(vehicles, dtype=np.int64)).tolist() == [expected, -1]


def test_silhouettes_of_vehicles_seen_twice_are_selected():
    silhouettes = [
        square(0, 100, 100, 10), square(1, 100, 100, 40),  # vehicle 0, which grows most
        square(0, 500, 100, 20), square(1, 500, 100, 30),  # vehicle 1
        square(1, 500, 160, 12),  # a part of it in the same frame
        square(2, 500, 100, 2),  # too small
        square(0, 900, 100, 20),  # vehicle 2, seen once
        square(0, 900, 500, 20), square(1, 900, 500, 20),  # nobody knows whose
    ]  # fmt: skip
    vehicles = np.array([0, 0, 1, 1, 1, 1, 2, -1, -1])
    assert select_silhouettes(silhouettes, vehicles, min_size_px=10, max_count=100).tolist() == [0, 1, 2, 3]
    assert select_silhouettes(silhouettes, vehicles, min_size_px=10, max_count=2).tolist() == [0, 1]
    assert select_silhouettes(silhouettes, np.full(9, -1), min_size_px=10, max_count=100).tolist() == []
