"""`labelgen speed` on a small road with cuboids of known speeds."""

from __future__ import annotations

import csv
import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from speed_scenes import FRAME_WH, Drive, frame_times, make_camera, make_road, write_scene
from stream_server import serve_stream

from detector.speed.contact_point import contact_distance_m
from labelgen.cli.main import main
from labelgen.geometry import Camera

DRIVES = [Drive(60.0, 38.0, 2.0), Drive(72.0, 16.0, -3.0, 1), Drive(48.0, 60.0, 2.2)]
SPEEDS = [60.0, 72.0, 48.0]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of road.mp4, 25 frames per second, with calibration, mask and masks.json."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, DRIVES, frame_times(4.0, 25.0))
    return folder


def run(*arguments: Any, near_end: str = "outline") -> int:
    """Cuboids end where their outlines do; vehicles do not."""
    with pytest.raises(SystemExit) as stop:
        main(["speed", *map(str, arguments), "--near-end", near_end])
    return int(stop.value.code or 0)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def speeds(folder: Path, variant: str = "transform3d") -> list[float]:
    found = rows(folder / f"vehicles_{variant}.csv")
    return [float(row["speed_kmh"]) for row in sorted(found, key=lambda row: float(row["first_s"]))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "pair", "tolerance"),
    [
        ("transform3d", "VP2-VP3", 0.5),
        ("transform3d", "VP1-VP2", 1.0),
        ("transform2d", "VP2-VP3", 0.5),
        ("maskrcnn3d", "VP2-VP3", 0.5),
        ("sochor", "VP2-VP3", 3.0),
        ("previous3d", "VP2-VP3", 1.0),
        ("previous2d", "VP2-VP3", 1.0),
        ("orig2d", "VP2-VP3", 2.0),
    ],
)
def test_every_variant_from_masks(scene: Path, tmp_path: Path, variant: str, pair: str, tolerance: float) -> None:
    code = run(
        scene / "road.mp4", "--from", f"masks:coco:{scene / 'masks.json'}", "--variant", variant, "--pair", pair,
        "--out", tmp_path, "--json", tmp_path / "s.json",
    )  # fmt: skip
    assert code == 0
    summary = json.loads((tmp_path / "s.json").read_text())
    assert (summary["frames"], summary["vehicles"], summary["variant"]) == (100, 3, variant)
    assert sorted(speeds(tmp_path / "road", variant)) == pytest.approx(sorted(SPEEDS), abs=tolerance)
    assert sorted(summary["files"]) == ["detections", "tracks", "vehicles"]


def test_outlines_of_vehicles_are_measured_at_their_near_ends(scene: Path, tmp_path: Path) -> None:
    masks = ("--from", f"masks:coco:{scene / 'masks.json'}")
    assert run(scene / "road.mp4", *masks, "--out", tmp_path / "outline") == 0
    assert run(scene / "road.mp4", *masks, "--out", tmp_path / "vehicle", near_end="vehicle") == 0
    camera = Camera.load(scene / "road.calibration.json", image_wh=FRAME_WH)
    ahead = []
    for folder in ("outline", "vehicle"):
        cars = json.loads((tmp_path / folder / "road" / "system_transform3d.json").read_text())["cars"]
        points = np.array([[car["posX"][3], car["posY"][3]] for car in cars])
        ahead.append(camera.road_points(points)[:, 0])
    np.testing.assert_allclose(ahead[1], contact_distance_m(ahead[0], camera.height_m), atol=0.02)
    # A file of detections says which of the two it is.
    again = ("--from", f"detections:{tmp_path / 'vehicle' / 'road' / 'detections_transform3d.jsonl'}")
    assert run(scene / "road.mp4", *again, "--out", tmp_path / "again") == 0
    assert speeds(tmp_path / "again" / "road") == pytest.approx(speeds(tmp_path / "vehicle" / "road"), abs=0.02)
    assert run(scene / "road.mp4", *masks, "--out", tmp_path / "no", near_end="middle") == 2


def test_dubska_measures_what_moves(scene: Path, tmp_path: Path) -> None:
    assert run(scene / "road.mp4", "--variant", "dubska", "--out", tmp_path) == 0
    table = rows(tmp_path / "road" / "vehicles_dubska.csv")
    assert sorted(float(row["speed_kmh"]) for row in table) == pytest.approx(sorted(SPEEDS), abs=3.0)
    head = json.loads((tmp_path / "road" / "detections_dubska.jsonl").read_text().splitlines()[0])
    assert (head["variant"], head["rectification"]) == ("dubska", None)
    again = ["--from", f"detections:{tmp_path / 'road' / 'detections_dubska.jsonl'}", "--out", tmp_path / "again"]
    assert run(scene / "road.mp4", *again) == 0
    assert speeds(tmp_path / "again" / "road", "dubska") == pytest.approx(speeds(tmp_path / "road", "dubska"), abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--variant", "dubska", "--from", "masks:maskrcnn"], "--variant dubska: its vehicles are all that moves"),
        (["--variant", "sochor", "--from", "masks:background"], "detections must say which silhouettes are vehicles"),
    ],
)
def test_masks_that_a_system_does_not_take(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert run(scene / "road.mp4", *arguments, "--out", tmp_path) == 2
    assert message in capsys.readouterr().err


def bare_video(scene: Path, folder: Path) -> Path:
    """The video alone, without calibration and road mask beside it."""
    path = folder / "bare.mp4"
    shutil.copy(scene / "road.mp4", path)
    return path


def test_what_an_earlier_run_made_is_used_again(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "out" / "bare"
    kept.mkdir(parents=True)
    shutil.copy(scene / "road.calibration.json", kept / "calibration.json")
    shutil.copy(scene / "road.mask.png", kept / "road_mask.png")
    video = bare_video(scene, tmp_path)
    assert run(video, "--from", f"masks:coco:{scene / 'masks.json'}", "--out", tmp_path / "out") == 0
    assert sorted(speeds(kept)) == pytest.approx(sorted(SPEEDS), abs=0.5)
    said = capsys.readouterr().err
    for what, name in (("calibration", "calibration.json"), ("road mask", "road_mask.png")):
        assert f"note: bare: no {what} given; using {kept / name} of an earlier run" in said


def test_a_road_mask_alone_is_made(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = bare_video(scene, tmp_path)
    calibration = ("--calibration", scene / "road.calibration.json")
    masks = ("--from", f"masks:coco:{scene / 'masks.json'}")
    assert run(video, *masks, *calibration, "--out", tmp_path / "out") == 0
    # Four seconds give no tracks to speak of in the far lane; the two near ones are road.
    found = speeds(tmp_path / "out" / "bare")
    assert len(found) >= 2
    assert all(min(abs(speed - true) for true in SPEEDS) < 0.5 for speed in found)
    assert (tmp_path / "out" / "bare" / "road_mask.png").is_file()
    assert "note: bare: no road mask given; making it from the video itself" in capsys.readouterr().err


def test_a_video_that_cannot_be_calibrated(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Four seconds with three vehicles are too little."""
    assert run(bare_video(scene, tmp_path), "--out", tmp_path / "out") == 2
    *notes, error = [line for line in capsys.readouterr().err.splitlines() if line.startswith(("note:", "labelgen:"))]
    assert "note: bare: no calibration and no road mask given; making them from the video itself" in notes
    assert error.startswith("labelgen: error: ")
    assert not (tmp_path / "out" / "bare" / "calibration.json").exists()


@pytest.mark.slow
def test_all_that_is_written(scene: Path, tmp_path: Path) -> None:
    assert run(scene / "road.mp4", "--from", f"masks:coco:{scene / 'masks.json'}", "--out", tmp_path, "--render") == 0
    folder = tmp_path / "road"
    table = rows(folder / "vehicles_transform3d.csv")
    assert {row["direction"] for row in table} == {"away", "towards"}
    assert all(row["lane"] == "" and row["class"] == "car" for row in table)
    size = np.array([[float(row[key]) for key in ("length_m", "width_m", "height_m")] for row in table])
    np.testing.assert_allclose(size, [[4.4, 1.8, 1.5]] * 3, atol=0.35)
    tracks = json.loads((folder / "system_transform3d.json").read_text())
    camera = make_camera(1 / 3).to_dict()["camera_calibration"]
    assert tracks["camera_calibration"]["vp1"] == pytest.approx(camera["vp1"])
    assert sorted(car["id"] for car in tracks["cars"]) == sorted(int(row["id"]) for row in table)
    assert all(len(car["frames"]) == len(car["posX"]) == len(car["posY"]) for car in tracks["cars"])
    lines = [json.loads(line) for line in (folder / "detections_transform3d.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines[1:]] == list(range(100))
    with av.open(str(folder / "annotated_transform3d.avi")) as video:
        pictures = [frame.to_ndarray(format="bgr24").astype(int) for frame in video.decode(video=0)]
    assert len(pictures) == 100
    assert pictures[0].shape == (360, 640, 3)
    # Something of the yellow, blue and red of the boxes is in them; the road is grey.
    assert all(np.ptp(picture, axis=2).max() > 60 for picture in pictures[10:90])


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["transform3d", "maskrcnn3d", "orig2d"])
def test_detections_give_the_same_speeds_again(scene: Path, tmp_path: Path, variant: str) -> None:
    video = scene / "road.mp4"
    masks = f"masks:coco:{scene / 'masks.json'}"
    assert run(video, "--from", masks, "--variant", variant, "--out", tmp_path / "a") == 0
    file = tmp_path / "a" / "road" / f"detections_{variant}.jsonl"
    assert run(video, "--from", f"detections:{file}", "--out", tmp_path / "b", "--render") == 0
    assert speeds(tmp_path / "b" / "road", variant) == pytest.approx(speeds(tmp_path / "a" / "road", variant), abs=0.02)
    assert (tmp_path / "b" / "road" / f"annotated_{variant}.avi").stat().st_size > 10000
    assert not (tmp_path / "b" / "road" / f"detections_{variant}.jsonl").exists()


@pytest.mark.slow
def test_background_masks_find_them_too(scene: Path, tmp_path: Path) -> None:
    assert run(scene / "road.mp4", "--out", tmp_path) == 0
    found = speeds(tmp_path / "road")
    assert any(abs(speed - 60.0) < 3 for speed in found)


def test_a_folder_of_frames_needs_a_rate(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "road"
    folder.mkdir()
    with av.open(str(scene / "road.mp4")) as video:
        for number, frame in enumerate(video.decode(video=0)):
            cv2.imwrite(str(folder / f"{number:04d}.png"), frame.to_ndarray(format="bgr24"))
    for name in ("road.calibration.json", "road.mask.png"):
        shutil.copy(scene / name, tmp_path / name)
    masks = f"masks:coco:{scene / 'masks.json'}"
    assert run(folder, "--from", masks, "--out", tmp_path / "a") == 2
    assert "give fps" in capsys.readouterr().err
    assert run(folder, "--from", masks, "--out", tmp_path / "b", "--fps", 25) == 0
    assert sorted(speeds(tmp_path / "b" / "road")) == pytest.approx(sorted(SPEEDS), abs=0.5)


def test_uneven_time_stamps(tmp_path: Path) -> None:
    """Frames come as they like; the speed is that of the clock."""
    rng = np.random.default_rng(5)
    times = np.round(np.cumsum(rng.uniform(0.02, 0.08, 80)), 3)
    video = write_scene(tmp_path / "scene", DRIVES, (times - times[0]).tolist())
    masks = f"masks:coco:{video.parent / 'masks.json'}"
    assert run(video, "--from", masks, "--out", tmp_path) == 0
    assert sorted(speeds(tmp_path / "road")) == pytest.approx(sorted(SPEEDS), abs=0.7)


def test_duration_ends_it(scene: Path, tmp_path: Path) -> None:
    masks = f"masks:coco:{scene / 'masks.json'}"
    options = ("--out", tmp_path, "--duration", 1.0, "--json", tmp_path / "s.json")
    assert run(scene / "road.mp4", "--from", masks, *options) == 0
    assert json.loads((tmp_path / "s.json").read_text())["frames"] == 25
    file = f"detections:{tmp_path / 'road' / 'detections_transform3d.jsonl'}"
    options = ("--out", tmp_path / "again", "--duration", 0.5, "--json", tmp_path / "t.json")
    assert run(scene / "road.mp4", "--from", file, *options) == 0
    assert json.loads((tmp_path / "t.json").read_text())["frames"] == 13


def test_a_session_has_lanes_and_can_be_scored(scene: Path, tmp_path: Path) -> None:
    """The tracks of a session go straight into `labelgen evaluate`."""
    session = tmp_path / "dataset" / "session9_center"
    session.mkdir(parents=True)
    shutil.copy(scene / "road.mp4", session / "video.mp4")
    camera = make_camera(1 / 3)
    cv2.imwrite(str(session / "video_mask.png"), make_road(camera).pixels.astype(np.uint8) * 255)
    results = tmp_path / "results" / "session9_center"
    results.mkdir(parents=True)
    (results / "system_optimal_calibration.json").write_text(json.dumps(camera.to_dict()))

    def line(ends: list[list[float]]) -> np.ndarray:
        first, second = np.hstack([camera.project(np.array(ends)), np.ones((2, 1))])
        return np.cross(first, second)

    def car(number: int, drive: Drive, lane: int) -> dict[str, Any]:
        crossings = [(x - drive.start_m) / (drive.heading * drive.speed_kmh / 3.6) for x in (20.0, 34.0)]
        return {
            "carId": number, "speed": drive.speed_kmh, "valid": True, "laneIndex": {lane},
            "intersections": [{"measurementLineId": k, "videoTime": crossings[k]} for k in (1, 0)],
        }  # fmt: skip

    truth = {
        "fps": 25.0,
        "cars": [car(0, DRIVES[0], 0), car(1, DRIVES[2], 0)],
        "measurementLines": [line([[x, -9.0], [x, 9.0]]) for x in (20.0, 34.0)],
        "laneDivLines": [line([[15.0, y], [40.0, y]]) for y in (5.5, -0.5, -5.5)],
        "invalidLanes": set(),
        "distanceMeasurement": [],
    }
    (session / "gt_data.pkl").write_bytes(pickle.dumps(truth, protocol=2))
    masks = f"masks:coco:{scene / 'masks.json'}"
    assert run(session, "--from", masks, "--out", tmp_path / "results") == 0
    assert sorted(row["lane"] for row in rows(results / "vehicles_transform3d.csv")) == ["0", "0", "1"]
    cars = json.loads((results / "system_transform3d.json").read_text())["cars"]
    assert len(cars) == 3
    assert run(session, "--from", masks, "--out", tmp_path / "results") == 2  # nothing is replaced unasked
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--dataset", str(tmp_path / "dataset"), "--results", str(tmp_path / "results"), "--system",
              "transform3d", "--recordings", "all", "--json", str(tmp_path / "e.json")])  # fmt: skip
    assert not stop.value.code
    pooled = json.loads((tmp_path / "e.json").read_text())["pooled"]["transform3d"]
    assert pooled["recall"] == 1.0
    assert pooled["mean"] < 0.5


WRONG = [
    ([], ("--from", "model:best.pt"), "best.pt: No such file"),
    ([], ("--from", "magic"), "unknown; use masks:background"),
    ([], ("--from", "masks:magic"), "unknown mask source"),
    ([], ("--from", "masks:coco:nowhere.json"), "no such file"),
    ([], ("--from", "detections:nowhere.jsonl"), "detections nowhere.jsonl"),
    ([], ("--variant", "4d"), "'4d' is not one of"),
    ([], ("--pair", "VP1-VP3"), "'VP1-VP3' is not one of"),
    ([], ("--size", "large"), "unknown size"),
    ([], ("--rule", "none"), "'none' is not one of"),
    ([], ("--calibration", "nowhere.json"), "no calibration at nowhere.json (option --calibration)"),
    (["road.calibration.json"], (), "give more video"),
    (["road.mp4"], (), "no such file or folder"),
]


@pytest.mark.parametrize(("missing", "options", "message"), WRONG)
def test_what_is_wrong_is_said_in_one_line(
    scene: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    missing: list[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    for name in missing:
        (copy / name).unlink()
    assert run(copy / "road.mp4", "--out", tmp_path / "out", *options) == 2
    [line] = [line for line in capsys.readouterr().err.splitlines() if "labelgen: error" in line]
    assert message in line
    assert not (tmp_path / "out").exists()


def test_a_camera_without_scale(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = json.loads((scene / "road.calibration.json").read_text())
    del camera["camera_calibration"]["scale"]
    (tmp_path / "c.json").write_text(json.dumps(camera))
    assert run(scene / "road.mp4", "--calibration", tmp_path / "c.json", "--out", tmp_path / "out") == 2
    assert "no scale" in capsys.readouterr().err


def test_a_detection_file_says_itself_how_it_was_made(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(scene / "road.mp4", "--from", f"masks:coco:{scene / 'masks.json'}", "--out", tmp_path) == 0
    file = f"detections:{tmp_path / 'road' / 'detections_transform3d.jsonl'}"
    assert run(scene / "road.mp4", "--from", file, "--pair", "VP1-VP2", "--out", tmp_path / "b") == 2
    assert "leave out --pair" in capsys.readouterr().err


# -- streams, and disks that fill --------------------------------------------------------------------


@pytest.fixture(scope="module")
def camera_feed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of road.ts; one vehicle has passed after 2 s, the last comes at the end."""
    folder = tmp_path_factory.mktemp("feed")
    write_scene(folder, DRIVES, frame_times(4.0, 25.0), suffix=".ts")
    return folder


def stream_options(feed: Path) -> list[Any]:
    return [
        "--calibration", feed / "road.calibration.json", "--road-mask", feed / "road.mask.png",
        "--from", f"masks:coco:{feed / 'masks.json'}",
    ]  # fmt: skip


def test_a_stream_that_ends(camera_feed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = (camera_feed / "road.ts").read_bytes()
    with serve_stream(data, announced=len(data)) as url:
        assert run(url, *stream_options(camera_feed), "--out", tmp_path, "--duration", 60) == 0
    assert sorted(speeds(tmp_path / "camera")) == pytest.approx(sorted(SPEEDS), abs=0.5)
    assert "the stream ended after" in capsys.readouterr().err


def test_a_stream_for_a_while(camera_feed: Path, tmp_path: Path) -> None:
    with serve_stream((camera_feed / "road.ts").read_bytes(), stall=True) as url:
        options = ("--out", tmp_path, "--duration", 2.5, "--render", "--json", tmp_path / "s.json")
        assert run(url, *stream_options(camera_feed), *options) == 0
    summary = json.loads((tmp_path / "s.json").read_text())
    assert 60 <= summary["frames"] <= 63
    assert summary["failure"] is None


def test_a_stream_that_stalls(camera_feed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serve_stream((camera_feed / "road.ts").read_bytes(), stall=True) as url:
        options = ("--stall", 0.6, "--out", tmp_path, "--json", tmp_path / "s.json")
        assert run(url, *stream_options(camera_feed), *options) == 2
    assert sorted(speeds(tmp_path / "camera"))[1:] == pytest.approx([60.0, 72.0], abs=0.5)
    err = capsys.readouterr().err
    assert "stalled, no data for 0.6 s" in err
    assert "3 finished vehicles are in" in err
    assert "stalled" in json.loads((tmp_path / "s.json").read_text())["failure"]


def test_a_stream_that_changes_its_resolution(
    camera_feed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from speed_scenes import write_video

    other = tmp_path / "other.ts"
    write_video(other, [np.zeros((240, 320, 3), np.uint8)] * 25, [4 + n / 25 for n in range(25)])
    with serve_stream((camera_feed / "road.ts").read_bytes() + other.read_bytes()) as url:
        assert run(url, *stream_options(camera_feed), "--out", tmp_path / "out") == 2
    assert "resolution changed from 640x360 to 320x240" in capsys.readouterr().err
    assert len(speeds(tmp_path / "out" / "camera")) == 3


def test_a_stream_needs_to_be_told_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("rtsp://127.0.0.1:1/live", "--out", tmp_path / "out") == 2
    assert (
        "a stream needs a calibration and a road mask of its own (options --calibration, --road-mask)"
        in capsys.readouterr().err
    )


@pytest.mark.slow
def test_a_stream_teaches_the_background_first(camera_feed: Path, tmp_path: Path) -> None:
    data = (camera_feed / "road.ts").read_bytes()
    with serve_stream(data, announced=len(data)) as url:
        options = [*stream_options(camera_feed)[:4], "--from", "masks:background"]
        assert run(url, *options, "--out", tmp_path, "--duration", 5, "--json", tmp_path / "s.json") == 0
    assert (
        70 <= json.loads((tmp_path / "s.json").read_text())["frames"] <= 76
    )  # of 100, the first second is learnt from


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "render"), [(12_000, False), (60_000, True)])
def test_a_disk_that_fills(scene: Path, tmp_path: Path, limit: int, render: bool) -> None:
    """A limit on the size of files stands in for the disk; the detections, or the video, are the first to reach it."""
    code = (
        f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
        "from labelgen.cli.main import main; main()"
    )
    arguments = ["speed", scene / "road.mp4", "--from", f"masks:coco:{scene / 'masks.json'}", "--out", tmp_path / "out"]
    done = run_code(code, [*arguments, *(["--render"] if render else [])])
    assert done.returncode == 2, done.stderr
    assert "file too large" in done.stderr
    folder = tmp_path / "out" / "road" / ".labelgen-speed-transform3d"
    assert f"finished vehicles are in {folder}" in done.stderr
    assert not list((tmp_path / "out" / "road").glob("*_transform3d.*"))  # nothing unfinished under a final name
    table = rows(folder / "vehicles_transform3d.csv")
    cars = json.loads((folder / "system_transform3d.json").read_text())["cars"]
    assert sorted(int(row["id"]) for row in table) == sorted(car["id"] for car in cars)
    assert len(table) >= 1
    for line in (folder / "detections_transform3d.jsonl").read_text().splitlines():
        json.loads(line)


def run_code(code: str, arguments: list[Any]) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).resolve().parents[3]
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=100,
    )


@pytest.mark.slow
def test_a_real_road(real_data: Path, tmp_path: Path) -> None:
    """A city street whose limit is 60 km/h, with a rough calibration; all vehicles drive away."""
    assert run(real_data / "videos" / "city_road_640x360.mp4", "--out", tmp_path, "--duration", 8) == 0
    table = rows(tmp_path / "city_road_640x360" / "vehicles_transform3d.csv")
    long = [row for row in table if int(row["points"]) > 60]
    assert len(long) >= 4
    assert {row["direction"] for row in long} == {"away"}
    assert all(30 < float(row["speed_kmh"]) < 75 for row in long)
    assert all(1.4 < float(row["width_m"]) < 3.0 for row in long)


def test_bodies_from_masks_and_from_their_file(scene: Path, tmp_path: Path) -> None:
    """Fitted tracks are whole when they end; their file of detections holds the outlines."""
    video = scene / "road.mp4"
    masks = f"masks:coco:{scene / 'masks.json'}"
    common = ("--variant", "fitted3d", "--overwrite")
    assert run(video, "--from", masks, *common, "--out", tmp_path / "a", near_end="vehicle") == 0
    # Cuboids are no bodies of vehicles.
    assert sorted(speeds(tmp_path / "a" / "road", "fitted3d")) == pytest.approx([48.0, 60.0, 72.0], abs=2.5)
    file = f"detections:{tmp_path / 'a' / 'road' / 'detections_fitted3d.jsonl'}"
    assert run(video, "--from", file, *common, "--out", tmp_path / "b", near_end="vehicle") == 0
    again = speeds(tmp_path / "b" / "road", "fitted3d")
    assert again == pytest.approx(speeds(tmp_path / "a" / "road", "fitted3d"), abs=0.02)


def test_bodies_refuse_what_does_not_go_with_them(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    video, masks = scene / "road.mp4", f"masks:coco:{scene / 'masks.json'}"
    assert run(video, "--from", masks, "--variant", "fitted3d", "--out", tmp_path / "a") == 2
    assert "--near-end" in capfd.readouterr().err
    assert run(video, "--from", masks, "--variant", "orig2d", "--out", tmp_path / "b") == 0
    file = f"detections:{tmp_path / 'b' / 'road' / 'detections_orig2d.jsonl'}"
    assert run(video, "--from", file, "--variant", "fitted3d", "--out", tmp_path / "c", near_end="vehicle") == 2
    assert "needs a detector's boxes with c_c" in capfd.readouterr().err
