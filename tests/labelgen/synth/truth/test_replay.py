"""Replays of real sessions: who drives where and when. Skipped without LABELGEN_REAL_DATA."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.synth.truth.session import write_session

pytestmark = pytest.mark.slow

REAL = os.environ.get("LABELGEN_REAL_DATA")
SCENES = ["session1_left", "session2_center", "session3_right", "session5_center"]
needs_real_data = pytest.mark.skipif(REAL is None, reason="LABELGEN_REAL_DATA names no real data")


def folder(name: str) -> Path:
    assert REAL is not None
    return Path(REAL) / "brnocompspeed" / "dataset" / name


@pytest.fixture(scope="module")
def replays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("replay")
    for name in SCENES:
        write_session(out, scene=folder(name), replay=True, duration_s=60, fps=50, video=False)
    return out


@needs_real_data
@pytest.mark.parametrize("name", SCENES)
def test_cars_cross_the_lines_at_their_recorded_times(name: str, replays: Path) -> None:
    real, new = load_pickle(folder(name) / "gt_data.pkl"), load_pickle(replays / "dataset" / name / "gt_data.pkl")
    recorded = {c["carId"]: c for c in real["cars"]}
    start = min(i["videoTime"] for c in real["cars"] for i in c["intersections"]) - 2.0
    assert len(new["cars"]) >= 2
    for car in new["cars"]:
        old = recorded[car["carId"]]
        assert car["laneIndex"] == old["laneIndex"]
        times = {i["measurementLineId"]: i["videoTime"] for i in car["intersections"]}
        for crossing in old["intersections"]:
            if crossing["measurementLineId"] in times:
                expected = crossing["videoTime"] - start
                assert times[crossing["measurementLineId"]] == pytest.approx(expected, abs=1e-6)


@needs_real_data
@pytest.mark.parametrize("name", SCENES)
def test_speeds_are_what_the_calibration_makes_of_the_tracks(name: str, replays: Path) -> None:
    result = json.loads((replays / "results" / name / "system_truth.json").read_text(encoding="utf-8"))
    camera = Camera.from_dict(result)
    speeds = {
        c["carId"]: c["speed"] for c in load_pickle(replays / "dataset" / name / "gt_data.pkl")["cars"] if c["valid"]
    }
    tracks = json.loads((replays / "truth" / name / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    numbers = {t["track_id"]: t["car_id"] for t in tracks}
    checked = 0
    for car in result["cars"]:
        number = numbers[car["id"]]
        if number in speeds and len(car["frames"]) > 20:
            places = camera.road_points(np.stack([car["posX"], car["posY"]], axis=1))
            way = np.linalg.norm(places[5:] - places[:-5], axis=1) / (np.diff(car["frames"]).mean() * 5) * 50 * 3.6
            assert np.median(way) == pytest.approx(speeds[number], abs=0.05)
            checked += 1
    assert checked >= 2


@needs_real_data
def test_cars_that_share_a_number_stay_apart(tmp_path: Path) -> None:
    recorded = [c["carId"] for c in load_pickle(folder("session0_center") / "gt_data.pkl")["cars"]]
    assert len(set(recorded)) < len(recorded)
    write_session(tmp_path, scene=folder("session0_center"), replay=True, duration_s=60, fps=5, video=False)
    text = (tmp_path / "truth" / "session0_center" / "boxes.jsonl").read_text(encoding="utf-8")
    last: dict[int, float] = {}
    for line in text.splitlines():
        for vehicle in json.loads(line)["vehicles"]:
            x = vehicle["near_xy_m"][0]
            assert abs(x - last.get(vehicle["track_id"], x)) < 12
            last[vehicle["track_id"]] = x


@needs_real_data
def test_a_time_without_traffic_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no crossing was recorded"):
        write_session(tmp_path, scene=folder("session2_center"), replay=True, duration_s=10, start_s=0, video=False)
