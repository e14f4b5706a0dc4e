"""The Luvizon protocol on a small data set in its layout, with numbers worked out by hand."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detector.evaluation.luvizon import luvizon_row, score_luvizon, track_lanes
from detector.tracking.tracks import Tracks
from labelgen.cli.main import main
from labelgen.datasets.luvizon import LuvizonVideo, read_luvizon_video, select_videos
from labelgen.errors import CalibrationError, DataError
from labelgen.geometry import Camera

FPS = 30.15
PX_PER_M = 20.0
# Lane k covers the pixels 600 (k - 1) < x < 600 k, whatever the order of its corners in the file.
CORNERS = ("pTopLeft", "pTopRight", "pBotLeft", "pBotRight")


def vehicle(
    lane: int,
    first: int,
    last: int,
    speed: float,
    *,
    moto: bool = False,
    plate: bool = True,
    sema: bool = False,
    radar: bool = True,
) -> str:
    child = f'<radar frame_start="{first}" frame_end="{last}" speed="{speed}"/>' if radar else ""
    return (
        f'<vehicle iframe="{first}" lane="{lane}" moto="{moto}" plate="{plate}" radar="{radar}" sema="{sema}">'
        f'<region x="1" y="2" w="3" h="4"/>{child}</vehicle>'
    )


def write_video(folder: Path, vehicles: Sequence[str]) -> Path:
    folder.mkdir(parents=True)
    listed = "".join(vehicles)
    (folder / "vehicles.xml").write_text(
        f'<?xml version="1.0"?><GroundTruthRoot><gtruth>{listed}</gtruth><videoframes total="900"/></GroundTruthRoot>'
    )
    lanes = []
    for lane in (1, 2, 3):
        x0, x1 = 600 * (lane - 1), 600 * lane
        for tag, y0, y1 in (("lane", 0, 1080), ("measure", 400, 800)):
            places = zip(CORNERS, ((x0, y0), (x1, y0), (x0, y1), (x1, y1)), strict=True)
            corners = "".join(f'<{name} x="{x}" y="{y}"/>' for name, (x, y) in places)
            lanes.append(f'<{tag} id="{lane}">{corners}</{tag}>')
    (folder / "lanes.xml").write_text(f'<config><nLanes total="3"/><lanes>{"".join(lanes)}</lanes></config>')
    scale = 1 / PX_PER_M
    (folder / "matrix.txt").write_text(f"{scale} 0 0\n0 {scale} 0\n0 0 1\n" * 3)
    return folder


def car(name: int, lane: int, first: int, last: int, kmh: float) -> dict[str, Any]:
    """A track along x = the lane's middle that has the given speed under matrix.txt: 20 px are a metre."""
    frames = list(range(first, last + 1))
    step = kmh / 3.6 / FPS * PX_PER_M
    return {
        "id": name,
        "frames": frames,
        "posX": [600.0 * lane - 300.0] * len(frames),
        "posY": [50.0 + step * i for i in range(len(frames))],
    }


VEHICLES = [
    vehicle(1, 100, 130, 50.0),  # measured 51.5: +1.5, within both
    vehicle(2, 200, 230, 60.0),  # measured 57.1: -2.9, within ours only
    vehicle(3, 300, 330, 40.0),  # measured 42.5: +2.5, within the public script's only
    vehicle(1, 400, 430, 45.0),  # measured 41.0: -4, within none
    vehicle(2, 500, 530, 55.0),  # no track
    vehicle(1, 600, 630, 55.0, moto=True),
    vehicle(1, 600, 630, 55.0, plate=False),
    vehicle(1, 600, 630, 55.0, sema=True),
    vehicle(1, 600, 630, 55.0, radar=False),
]
CARS = [
    car(0, 1, 105, 140, 51.5),
    car(1, 2, 190, 220, 57.1),
    car(2, 3, 300, 330, 42.5),
    car(3, 1, 425, 450, 41.0),
    car(4, 1, 505, 535, 55.0),  # at the time of the fifth vehicle, but in another lane
    car(5, 2, 531, 560, 55.0),  # in its lane, but one frame too late
]


@pytest.fixture
def video(tmp_path: Path) -> LuvizonVideo:
    return read_luvizon_video(write_video(tmp_path / "subset01" / "video01", VEHICLES))


def test_vehicles_that_do_not_count_are_left_out_with_the_reason(video: LuvizonVideo) -> None:
    assert video.name == "subset01/video01"
    assert video.lanes.tolist() == [1, 2, 3, 1, 2]
    assert video.frames.tolist() == [[100, 130], [200, 230], [300, 330], [400, 430], [500, 530]]
    assert video.left_out == {"motorcycle": 1, "without plate": 1, "sema": 1, "without radar": 1}


def test_figures_by_hand(video: LuvizonVideo) -> None:
    score = score_luvizon(video, Tracks.from_cars(CARS), None)
    assert score.tracks.tolist() == [0, 1, 2, 3, -1]
    np.testing.assert_allclose(score.speeds_kmh, [51.5, 57.1, 42.5, 41.0, np.nan])
    row = luvizon_row([score])
    assert (row["vehicles"], row["matched"], row["recall"]) == (5, 4, 0.8)
    assert (row["within_matched"], row["within_all"]) == (2 / 4, 2 / 5)
    assert (row["within_matched_public"], row["within_all_public"]) == (2 / 4, 2 / 5)
    assert row["bias"] == pytest.approx((1.5 - 2.9 + 2.5 - 4) / 4)
    assert row["mean"] == pytest.approx((1.5 + 2.9 + 2.5 + 4) / 4)
    assert row["median"] == pytest.approx(2.7)
    assert row["worst"] == pytest.approx(4.0)


def test_the_two_signs_differ(video: LuvizonVideo) -> None:
    # Measured 2.5 km/h less than true: within [-3, +2], but not within the public script's true - measured.
    cars = [car(0, 1, 100, 130, 47.5), car(1, 2, 200, 230, 57.5)]
    row = luvizon_row([score_luvizon(video, Tracks.from_cars(cars), None)])
    assert (row["within_matched"], row["within_matched_public"]) == (1.0, 0.0)
    assert (row["within_all"], row["within_all_public"]) == (0.4, 0.0)


def test_one_scale_for_each_lane(video: LuvizonVideo) -> None:
    score = score_luvizon(video, Tracks.from_cars(CARS), None, [1.0, 2.0, 0.5])
    np.testing.assert_allclose(score.speeds_kmh, [51.5, 2 * 57.1, 42.5 / 2, 41.0, np.nan])


def test_a_calibration_measures_all_lanes(video: LuvizonVideo) -> None:
    camera = Camera(np.array([900.0, -350.0]), np.array([40000.0, 560.0]), np.array([960.5, 540.5]), 0.024)
    frames = np.arange(200, 231)
    pixels = camera.project(np.stack([14 + frames / FPS * 10 - 200 / FPS * 10, np.full(len(frames), -0.5)], axis=1))
    cars = [{"id": 0, "frames": frames.tolist(), "posX": pixels[:, 0].tolist(), "posY": pixels[:, 1].tolist()}]
    assert (pixels[:, 0] > 600).all()
    assert (pixels[:, 0] < 1200).all()
    score = score_luvizon(video, Tracks.from_cars(cars), camera, [1.0, 1.5, 1.0])
    np.testing.assert_allclose(score.speeds_kmh, [np.nan, 36 * 1.5, np.nan, np.nan, np.nan])


def test_the_best_overlap_wins_and_each_track_serves_once(tmp_path: Path) -> None:
    folder = write_video(tmp_path / "subset01" / "video01", [vehicle(1, 100, 119, 50.0), vehicle(1, 115, 134, 50.0)])
    truth = read_luvizon_video(folder)
    # IoU with the first vehicle: 10 / 30 and 18 / 22; with the second one 20 / 25 and 5 / 37.
    cars = [car(0, 1, 110, 134, 40.0), car(1, 1, 102, 121, 60.0)]
    score = score_luvizon(truth, Tracks.from_cars(cars), None)
    assert score.tracks.tolist() == [1, 0]
    assert score_luvizon(truth, Tracks.from_cars(cars[:1]), None).tracks.tolist() == [0, -1]
    assert score_luvizon(truth, Tracks.from_cars([]), None).tracks.tolist() == [-1, -1]


def test_overlap_counts_in_proportion(tmp_path: Path) -> None:
    truth = read_luvizon_video(write_video(tmp_path / "subset01" / "video01", [vehicle(1, 100, 119, 50.0)]))
    # The first track covers all 20 frames of the vehicle but lasts 71, the second one 17 of its own 17.
    cars = [car(0, 1, 90, 160, 20.0), car(1, 1, 103, 119, 60.0)]
    assert score_luvizon(truth, Tracks.from_cars(cars), None).tracks.tolist() == [1]


def test_a_tracks_lane_is_where_most_of_its_points_are(video: LuvizonVideo) -> None:
    track = car(0, 1, 100, 109, 50.0)
    tracks = Tracks.from_cars(
        [
            track | {"posX": [300.0] * 6 + [900.0] * 4},
            track | {"posX": [300.0] * 4 + [900.0] * 6},
            track | {"posX": [1900.0] * 10},
            track | {"posX": [1900.0] * 9 + [1500.0]},
        ]
    )
    assert track_lanes(tracks, video).tolist() == [1, 2, 0, 3]


def test_tracks_too_short_for_a_speed_are_not_taken(video: LuvizonVideo) -> None:
    score = score_luvizon(video, Tracks.from_cars([car(0, 1, 100, 104, 50.0), {"id": 1, "posX": 3}]), None)
    assert score.tracks.tolist() == [-1] * 5
    assert (score.tracks_read, score.tracks_unused) == (2, 1)
    row = luvizon_row([score])
    assert (row["recall"], row["within_all"], row["within_matched"], row["mean"]) == (0.0, 0.0, None, None)


@pytest.mark.parametrize("scales", [[1.0, 2.0], [1.0, 1.0, 0.0], [1.0, 1.0, float("nan")]])
def test_wrong_lane_scales_are_refused(video: LuvizonVideo, scales: list[float]) -> None:
    with pytest.raises(CalibrationError, match="lane_scales"):
        score_luvizon(video, Tracks.from_cars(CARS), None, scales)


BOMB = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "boom"><!ENTITY c "&b;&b;&b;">]><a><g>&c;</g></a>'
OUTSIDE = '<?xml version="1.0"?><!DOCTYPE a SYSTEM "file:///etc/passwd"><a><g/></a>'


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("vehicles.xml", BOMB, "document type"),
        ("vehicles.xml", OUTSIDE, "document type"),
        ("lanes.xml", BOMB, "document type"),
        ("vehicles.xml", "<a><b></a>", "not XML"),
        ("vehicles.xml", "", "not XML"),
        ("vehicles.xml", "<a/>", "it has none"),
        ("vehicles.xml", f"<a><g>{vehicle(4, 1, 2, 50)}</g></a>", "vehicle 1: expected lane 1 to 3"),
        ("vehicles.xml", f"<a><g>{vehicle(1, 9, 2, 50)}</g></a>", "frame_start <= frame_end"),
        ("vehicles.xml", f"<a><g>{vehicle(1, 1, 2, float('nan'))}</g></a>", "positive speed"),
        ("vehicles.xml", '<a><g><v lane="x" plate="True"><radar/></v></g></a>', "vehicle 1"),
        ("vehicles.xml", '<a><g><v lane="1" plate="True"><radar frame_start="1"/></v></g></a>', "is missing"),
        ("lanes.xml", "<a><lane id='1'/></a>", "expected polygons"),
        ("matrix.txt", "1 0 0\n0 1 0\n", "9 rows"),
        ("matrix.txt", "a b c\n" * 9, "9 rows"),
        ("matrix.txt", "0 0 0\n" * 9, "not invertible"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, file: str, text: str, message: str) -> None:
    folder = write_video(tmp_path / "subset01" / "video01", VEHICLES)
    (folder / file).write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        read_luvizon_video(folder)
    assert file in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_a_document_type_cannot_hide_in_an_encoding(tmp_path: Path, encoding: str) -> None:
    folder = write_video(tmp_path / "subset01" / "video01", VEHICLES)
    (folder / "vehicles.xml").write_bytes(BOMB.encode(encoding))
    with pytest.raises(DataError, match="document type"):
        read_luvizon_video(folder)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    folder = write_video(tmp_path / "subset01" / "video01", VEHICLES)
    (folder / "matrix.txt").unlink()
    with pytest.raises(DataError, match=r"matrix\.txt: no such file"):
        read_luvizon_video(folder)


def test_the_first_half_of_each_subset_is_for_testing(tmp_path: Path) -> None:
    for name in ("subset01/video01", "subset01/video02", "subset01/video03", "subset02/video06", "subset02/video07"):
        write_video(tmp_path / name, [])
    write_video(tmp_path / "subset05/video01", [])
    assert select_videos(tmp_path, "test") == [
        "subset01/video01",
        "subset01/video02",
        "subset02/video06",
        "subset05/video01",
    ]
    assert select_videos(tmp_path, "training") == ["subset01/video03", "subset02/video07"]
    assert select_videos(tmp_path, "subset02/video07") == ["subset02/video07"]
    with pytest.raises(DataError, match="no video subset09/video01"):
        select_videos(tmp_path, "subset09/video01")


def test_evaluate_knows_the_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = Camera(np.array([900.0, -350.0]), np.array([40000.0, 560.0]), np.array([960.5, 540.5]), 0.024)
    calibration = camera.to_dict()["camera_calibration"] | {"lane_scales": [1.0, 1.1, 1.0]}
    for number in (1, 2):
        write_video(tmp_path / f"dataset/subset01/video{number:02d}", VEHICLES)
        folder = tmp_path / f"results/subset01/video{number:02d}"
        folder.mkdir(parents=True)
        (folder / "system_ours.json").write_text(json.dumps({"camera_calibration": calibration, "cars": CARS}))
    command = ["evaluate", "--dataset", str(tmp_path / "dataset"), "--results", str(tmp_path / "results")]
    report = tmp_path / "report.json"
    with pytest.raises(SystemExit) as stop:
        main([*command, "--system", "ours", "--json", str(report)])
    assert stop.value.code == 0
    data = json.loads(report.read_text())
    assert [row["recording"] for row in data["rows"]] == ["subset01/video01", "subset01/video02"]
    assert (data["pooled"]["ours"]["vehicles"], data["pooled"]["ours"]["matched"]) == (10, 8)
    assert "pooled" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        main([*command, "--system", "ours", "--common-recall"])
    assert stop.value.code == 2
    assert "Luvizon layout" in capsys.readouterr().err
