"""The BrnoCompSpeed protocol on made-up traffic whose score is known beforehand."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from score_scenes import Traffic, make_scene

from detector.evaluation.brnocompspeed import RecordingScore, score_recording
from detector.evaluation.summary import absolute_errors, recording_row
from labelgen.datasets.brnocompspeed import parse_ground_truth
from labelgen.errors import CalibrationError, DataError
from labelgen.geometry import Camera
from tools.benchmarks.score_reference import score_car_by_car


def score(scene: Traffic) -> RecordingScore:
    return score_recording(scene.truth(), scene.tracks(), scene.camera)


def row(scene: Traffic) -> dict[str, Any]:
    return recording_row("made-up", "system_x.json", "own", score(scene))


def test_perfect_tracks_score_perfectly(traffic: Traffic) -> None:
    got = row(traffic)
    assert (got["n"], got["matched"], got["false_positives"], got["intersection_failures"]) == (4, 4, 0, 0)
    assert (got["recall"], got["precision"]) == (1.0, 1.0)
    assert got["worst"] == pytest.approx(0, abs=1e-9)
    assert got["distance_error_m_mean"] == pytest.approx(0, abs=1e-9)
    assert got["calibration_ratio_error_absolute_mean"] == pytest.approx(0, abs=1e-9)


def test_figures_by_hand(traffic: Traffic) -> None:
    # True speeds 72, 90, 108, 81 km/h; said to be 70, 91, 108, 85: errors 2, 1, 0, 4.
    for car, kmh in zip(traffic.truth_cars, (70.0, 91.0, 108.0, 85.0), strict=True):
        car["speed"] = kmh
    got = row(traffic)
    assert got["mean"] == pytest.approx(7 / 4)
    assert got["median"] == pytest.approx(1.5)
    # Linear interpolation between the third and fourth of 0, 1, 2, 4: at 0.95 * 3 = 2.85.
    assert got["p95"] == pytest.approx(2 + 0.85 * 2)
    assert got["worst"] == pytest.approx(4)
    relative = [200 / 70, 100 / 91, 0, 400 / 85]
    assert got["mean_relative"] == pytest.approx(np.mean(relative))
    assert got["median_relative"] == pytest.approx(np.median(relative))


def test_calibration_and_distance_errors_by_hand(traffic: Traffic) -> None:
    # A scale 10 % too large makes 11 m of 10 and 7.7 m of 7; the ratios are not touched.
    camera = Camera(traffic.camera.vp1, traffic.camera.vp2, traffic.camera.pp, traffic.camera.scale * 1.1)
    got = recording_row("r", "t", "own", score_recording(traffic.truth(), traffic.tracks(), camera))
    assert got["distance_error_m_mean"] == pytest.approx((1.0 + 0.7) / 2)
    assert got["distance_error_relative_mean"] == pytest.approx(10)
    assert got["calibration_ratio_error_absolute_mean"] == pytest.approx(0, abs=1e-9)
    assert got["mean_relative"] == pytest.approx(10)
    # A segment said to be 14 m instead of 10: ratio 10/7 instead of 2, an error of 4/7 or 28.6 %.
    data = traffic.truth_data()
    data["distanceMeasurement"][0]["distance"] = 14.0
    got = recording_row("r", "t", "own", score_recording(parse_ground_truth(data), traffic.tracks(), traffic.camera))
    assert got["calibration_ratio_error_absolute_mean"] == pytest.approx(4 / 7)
    assert got["calibration_ratio_error_relative_mean"] == pytest.approx(200 / 7)


def test_missed_and_spare_tracks(traffic: Traffic) -> None:
    traffic.add_truth(11.8, 20.0, 2)  # nobody saw this one
    traffic.add_track(12.0, 20.0, 1)  # and this one was not there
    got = row(traffic)
    assert (got["n"], got["matched"], got["false_positives"]) == (4, 4, 1)
    assert (got["recall"], got["precision"]) == (4 / 5, 4 / 5)


def test_invalid_cars_are_matched_but_do_not_count(traffic: Traffic) -> None:
    traffic.truth_cars[1]["valid"] = False
    got = row(traffic)
    assert (got["n"], got["matched"], got["recall"], got["false_positives"]) == (3, 4, 1.0, 0)


@pytest.mark.parametrize(("shift_s", "matched"), [(0.19, True), (-0.19, True), (0.21, False), (-0.21, False)])
def test_match_window_is_a_fifth_of_a_second(scene: Traffic, shift_s: float, matched: bool) -> None:
    scene.add_truth(5.0, 20.0, 0)
    scene.add_truth(10.0, 20.0, 0)
    scene.add_truth(15.0, 20.0, 0)
    scene.add_track(10.0 + shift_s, 20.0, 0)
    assert score(scene).matched.tolist() == [False, matched, False]


def test_the_lane_must_agree_and_a_car_may_have_several(scene: Traffic) -> None:
    scene.add_truth(10.0, 20.0, 0)
    scene.add_truth(11.0, 20.0, {0, 1})
    scene.add_truth(12.0, 20.0, {0, 7})
    for last_s in (10.0, 11.0, 12.0):
        scene.add_track(last_s, 20.0, 1)
    assert score(scene).matched.tolist() == [False, True, False]


def test_the_nearest_in_time_wins_whatever_its_lane(scene: Traffic) -> None:
    scene.add_truth(10.0, 20.0, {0, 1, 2})
    scene.add_truth(13.0, 20.0, 0)
    for last_s, speed, lane in ((10.1, 21.0, 0), (9.95, 22.0, 2), (10.15, 23.0, 1)):
        scene.add_track(last_s, speed, lane)
    assert score(scene).speeds_kmh[0] == pytest.approx(22.0 * 3.6)


def test_of_two_equally_near_tracks_the_first_in_the_file_wins(scene: Traffic) -> None:
    scene.add_truth(10.0, 20.0, {0, 1})
    scene.add_truth(13.0, 20.0, 0)
    scene.cars += [scene.track(10.0, 20.0, 1, "straight"), scene.track(10.0, 20.0, 1, "wavering")]
    # Far from the measurement lines, so that the crossings stay the same and only the speed differs.
    for i in range(18, len(scene.cars[1]["posX"]) - 18):
        scene.cars[1]["posX"][i] += 6.0 * (-1) ** i
    assert score(scene).speeds_kmh[0] == pytest.approx(72.0)
    scene.cars.reverse()
    assert score(scene).speeds_kmh[0] > 72.1


def test_one_track_may_serve_two_cars(scene: Traffic) -> None:
    scene.add_truth(10.0, 20.0, 0)
    scene.add_truth(10.15, 25.0, 0)
    scene.add_truth(13.0, 25.0, 0)
    scene.add_track(10.05, 20.0, 0)
    got = row(scene)
    assert (got["matched"], got["n"], got["false_positives"]) == (2, 2, 0)
    assert got["worst"] == pytest.approx(18.0)


@pytest.mark.parametrize(("last_s", "counted"), [(9.9, 0), (10.1, 1), (14.9, 1), (15.1, 0)])
def test_false_positives_only_within_the_ground_truths_time(scene: Traffic, last_s: float, counted: int) -> None:
    scene.add_truth(10.0, 20.0, 0)
    scene.add_truth(15.0, 20.0, 0)
    scene.add_track(last_s, 20.0, 1)
    assert score(scene).false_positives == counted


def test_tracks_of_one_name_are_one_vehicle(traffic: Traffic) -> None:
    traffic.add_track(12.0, 20.0, 1, name=2)  # another one is called 2, and is matched
    assert score(traffic).false_positives == 0
    for car in traffic.cars:
        del car["id"]
    assert score(traffic).false_positives == 1


def test_vertical_and_standing_tracks_are_failures_not_crashes(traffic: Traffic) -> None:
    model = traffic.track(12.0, 20.0, 1, "vertical")
    middle = float(np.median(model["posX"]))
    traffic.cars.append(model | {"posX": [middle] * len(model["posX"])})
    standing = traffic.track(12.0, 20.0, 1, "standing")
    count, place = len(standing["posX"]), len(standing["posX"]) // 2
    standing |= {key: [standing[key][place]] * count for key in ("posX", "posY")}
    traffic.cars.append(standing)
    got = row(traffic)
    assert (got["intersection_failures"], got["false_positives"], got["n"]) == (2, 2, 4)


def test_a_track_without_passing_time_is_a_failure(traffic: Traffic) -> None:
    frozen = traffic.track(12.0, 20.0, 1)
    traffic.cars.append(frozen | {"frames": [600 + i // 20 for i in range(len(frozen["frames"]))]})
    got = row(traffic)
    assert got["intersection_failures"] == 1
    assert math.isfinite(got["mean"])


def test_a_car_on_a_lane_border_counts_in_the_first_lane(scene: Traffic) -> None:
    data = {"fps": 50.0, "invalidLanes": set(), "distanceMeasurement": []}
    data["measurementLines"] = [np.array([0.0, 1.0, -900.0]), np.array([0.0, 1.0, -200.0])]
    data["laneDivLines"] = [np.array([1.0, 0.0, -x]) for x in (400.0, 800.0, 1200.0)]
    crossing = {"measurementLineId": 0, "videoTime": 900 / 10 / 50}
    car = {"carId": 0, "speed": 50.0, "valid": True, "intersections": [crossing]}
    data["cars"] = [car | {"laneIndex": {0}}, car | {"laneIndex": {1}}, car | {"laneIndex": {1}}]
    data["cars"][2] = data["cars"][2] | {"intersections": [{"measurementLineId": 0, "videoTime": 99.0}]}
    # The track wavers by a hair around the border x = 800, so that its fit has a slope; its mean lies on it.
    scene.cars = [
        {
            "id": 0,
            "frames": list(range(2, 105)),
            "posX": [800.0 + (-1) ** frame * 2.0**-20 for frame in range(2, 105)],
            "posY": [10.0 * frame for frame in range(2, 105)],
        }
    ]
    got = score_recording(parse_ground_truth(data), scene.tracks(), scene.camera)
    assert got.dropped == {}
    assert got.matched.sum() + got.intersection_failures == 1
    scene.cars[0]["posX"] = [800.0] * 103
    on_border = score_recording(parse_ground_truth(data), scene.tracks(), scene.camera)
    assert (on_border.dropped, on_border.intersection_failures) == ({}, 1)
    scene.cars[0]["posX"] = [400.0 + 0.0 * frame for frame in range(2, 105)]
    assert score_recording(parse_ground_truth(data), scene.tracks(), scene.camera).dropped == {}
    scene.cars[0]["posX"][50] = 399.0
    outside = score_recording(parse_ground_truth(data), scene.tracks(), scene.camera)
    assert outside.dropped == {"outside the lanes": 1}


def test_invalid_lanes_take_their_tracks_but_not_their_cars(traffic: Traffic) -> None:
    traffic.invalid_lanes = {0}
    got = row(traffic)
    assert (got["n"], got["matched"], got["recall"], got["false_positives"]) == (2, 2, 0.5, 0)
    assert score(traffic).dropped == {"in an invalid lane": 2}


def test_no_tracks_at_all(traffic: Traffic) -> None:
    traffic.cars = []
    got = row(traffic)
    assert (got["n"], got["matched"], got["false_positives"], got["recall"]) == (0, 0, 0, 0.0)
    assert all(got[key] is None for key in ("mean", "median", "p95", "worst", "mean_relative", "precision"))
    assert got["distance_error_m_mean"] == pytest.approx(0, abs=1e-9)
    json.dumps(got, allow_nan=False)


def test_no_valid_cars_and_no_surveyed_segments(traffic: Traffic) -> None:
    data = traffic.truth_data() | {"distanceMeasurement": []}
    for car in data["cars"]:
        car["valid"] = False
    got = recording_row("r", "t", "own", score_recording(parse_ground_truth(data), traffic.tracks(), traffic.camera))
    assert (got["n"], got["matched"], got["recall"]) == (0, 4, None)
    assert got["distance_error_m_mean"] is None
    assert got["calibration_ratio_error_relative_mean"] is None


def test_a_calibration_without_scale_is_refused(traffic: Traffic) -> None:
    camera = Camera(traffic.camera.vp1, traffic.camera.vp2, traffic.camera.pp, name="bare")
    with pytest.raises(CalibrationError, match=r"bare.*no scale"):
        score_recording(traffic.truth(), traffic.tracks(), camera)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cars": []}, "no cars"),
        ({"fps": 0.0}, "fps"),
        ({"measurementLines": [np.array([0.0, 1.0, -5.0])]}, "measurementLines: expected at least two"),
        ({"laneDivLines": []}, "laneDivLines"),
        ({"laneDivLines": [np.zeros(3), np.ones(3)]}, "laneDivLines: a line"),
        ({"laneDivLines": 3}, "layout"),
        ({"distanceMeasurement": [{"p1": np.ones(3), "p2": np.ones(3), "distance": 0.0}]}, "positive distances"),
        ({"cars": [{"speed": 1}]}, "key 'intersections' is missing"),
        ({"cars": [{"carId": 7, "intersections": []}]}, "car 7 crosses no measurement line"),
    ],
)
def test_ground_truth_that_cannot_be_scored_is_refused(traffic: Traffic, change: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        parse_ground_truth(traffic.truth_data() | change)
    assert "\n" not in str(caught.value)


def test_ground_truth_that_is_something_else_is_refused() -> None:
    with pytest.raises(DataError, match="expected a dict"):
        parse_ground_truth([1, 2])


def nasty(rng: np.random.Generator) -> Traffic:
    """Traffic with misses, wrong lanes, noise, cuts, vertical and standing tracks, shared names and bad lanes."""
    scene = make_scene()
    for last_s in np.cumsum(rng.uniform(0.1, 1.5, 30)) + 5:
        lane, speed = int(rng.integers(3)), float(rng.uniform(10, 40))
        lanes = {lane} if rng.random() < 0.8 else {lane, int(rng.integers(4))}
        scene.add_truth(float(last_s), speed, lanes, valid=bool(rng.random() < 0.8))
        if rng.random() < 0.15:
            continue
        lane = lane if rng.random() < 0.9 else int(rng.integers(4))
        car = scene.track(float(last_s + rng.normal(0, 0.08)), speed * float(rng.normal(1, 0.05)), lane)
        x, y = np.array(car["posX"]), np.array(car["posY"])
        x, y = x + rng.normal(0, 2, len(x)), y + rng.normal(0, 2, len(y))
        kind = rng.random()
        if kind < 0.1:
            x[:] = np.round(x.mean())
        elif kind < 0.2:
            x, y = np.round(x / 8) * 8, np.round(y / 8) * 8
        elif kind < 0.25:
            y[:] = 300.0
        keep = slice(int(rng.integers(0, 20)), int(rng.integers(len(x) // 2, len(x) + 1)))
        car |= {"posX": x[keep].tolist(), "posY": y[keep].tolist(), "frames": car["frames"][keep]}
        if rng.random() < 0.1:
            car["id"] = 0
        scene.cars.append(car)
    scene.invalid_lanes = {2} if rng.random() < 0.3 else set()
    return scene


@pytest.mark.slow
@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_agrees_with_the_protocol_car_by_car(seed: int, low_horizon: bool) -> None:
    scene = nasty(np.random.default_rng(seed))
    data = scene.truth_data()
    # A calibration whose horizon runs through the tracks: its numbers mean nothing, but the protocol has them.
    camera = Camera(np.array([900.0, 250.0]), np.array([5000.0, 300.0]), np.array([960.5, 540.5]), 0.02)
    camera = camera if low_horizon else scene.camera
    expected = score_car_by_car(scene.cars, data, camera.to_dict()["camera_calibration"])
    got = score_recording(parse_ground_truth(data), scene.tracks(), camera)
    assert got.matched.sum() == expected["matched"]
    assert got.false_positives == expected["false_positives"]
    assert got.intersection_failures == expected["intersection_failures"]
    np.testing.assert_allclose(absolute_errors(got), expected["errors"], rtol=1e-6, atol=1e-6)


def test_of_equally_near_tracks_in_two_lanes_the_first_in_the_file_wins(scene: Traffic) -> None:
    # Lanes 400 < x < 800 < 1200. The tracks y = 8 x + const are exact in binary, so that both cross y = 900 in the very
    # same instant; being in different parts of the picture, they have different speeds.
    crossing = {"measurementLineId": 0, "videoTime": 1.8}
    data = {"fps": 50.0, "invalidLanes": set(), "distanceMeasurement": []}
    data["measurementLines"] = [np.array([0.0, 1.0, -900.0]), np.array([0.0, 1.0, -200.0])]
    data["laneDivLines"] = [np.array([1.0, 0.0, -x]) for x in (400.0, 800.0, 1200.0)]
    car = {"carId": 0, "speed": 50.0, "valid": True, "laneIndex": {0, 1}, "intersections": [crossing]}
    data["cars"] = [car, car | {"intersections": [{"measurementLineId": 0, "videoTime": 99.0}]}]
    frames = list(range(10, 100))
    ys = [10.0 * frame + 5 for frame in frames]
    tracks = []
    for name, x in (("left", 500.0), ("right", 900.0)):
        tracks.append({"id": name, "frames": frames, "posY": ys, "posX": [x + (y - 900) / 8 for y in ys]})
    scores = []
    for scene.cars in (tracks, tracks[::-1]):
        scores.append(score_recording(parse_ground_truth(data), scene.tracks(), scene.camera))
        expected = score_car_by_car(scene.cars, data, scene.camera.to_dict()["camera_calibration"])
        assert absolute_errors(scores[-1]) == pytest.approx(expected["errors"])
    assert scores[0].speeds_kmh[0] != scores[1].speeds_kmh[0]


@pytest.mark.parametrize("value", [10**400, float("inf"), None, "x", []])
def test_numbers_of_the_ground_truth_that_are_none_are_one_error(traffic: Traffic, value: object) -> None:
    for key in ("fps", "cars", "laneDivLines"):
        with pytest.raises(DataError):
            parse_ground_truth({**traffic.truth_data(), key: value})
    data = traffic.truth_data()
    data["cars"][1]["intersections"][-1]["videoTime"] = value
    with pytest.raises(DataError):
        parse_ground_truth(data)
