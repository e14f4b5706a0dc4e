"""Traffic in somebody's own video; the video is one the renderer made, so that everything about it is known."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from labelgen.cli.main import main
from labelgen.cli.synth import synth_app
from labelgen.datasets.safe_pickle import load_pickle
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.geometry.camera import look_at_road
from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.footage import Footage
from labelgen.synth.fitting.lanes import find_lanes
from labelgen.synth.fitting.sun import find_shadows
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.scene.road_image import draw_road
from labelgen.synth.scene.scene import RoadScene, procedural_scene
from labelgen.synth.scene.traffic import random_traffic
from labelgen.synth.sensor.sensor import PLAIN, Sensor
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.truth.session import place, write_session
from tools.studies.check_truth import check_session

pytestmark = pytest.mark.slow

SIZE = (480, 270)
NAME = "own"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with own.avi and what belongs to it, and the session it comes from."""
    root = tmp_path_factory.mktemp("made")
    write_session(
        root, duration_s=24, fps=10, size_wh=SIZE, seed=21, weather=Weather.OVERCAST, heading=-1, per_minute=14,
        kinds=["hatchback", "saloon", "estate"],
    )  # fmt: skip
    dataset, results = root / "dataset" / "session0_center", root / "results" / "session0_center"
    shutil.copy(dataset / "video.avi", root / f"{NAME}.avi")
    shutil.copy(dataset / "video_mask.png", root / f"{NAME}.mask.png")
    shutil.copy(results / "system_optimal_calibration.json", root / f"{NAME}.calibration.json")
    return root


@pytest.fixture(scope="module")
def session(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    arguments = ["session", "--scene", str(made / f"{NAME}.avi"), "--out", str(out), "--duration", "2", "--seed", "1"]
    result = CliRunner().invoke(synth_app, [*arguments, "--plates", "blue"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "measured on the video" in result.output
    return out


def frames_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="bgr24") for f in container.decode(video=0)]


def test_the_session_has_the_videos_camera_road_size_and_rate(made: Path, session: Path) -> None:
    given = Camera.load(made / f"{NAME}.calibration.json", image_wh=SIZE)
    camera = Camera.load(session / "results" / NAME / "system_optimal_calibration.json", image_wh=SIZE)
    np.testing.assert_allclose(camera.vp1, given.vp1)
    assert camera.scale == given.scale
    mask = cv2.imread(str(session / "dataset" / NAME / "video_mask.png"), cv2.IMREAD_GRAYSCALE)
    assert (mask == cv2.imread(str(made / f"{NAME}.mask.png"), cv2.IMREAD_GRAYSCALE)).all()
    frames = frames_of(session / "dataset" / NAME / "video.avi")
    assert len(frames) == 20
    assert frames[0].shape == (270, 480, 3)


def test_its_empty_road_is_that_of_the_video(made: Path, session: Path) -> None:
    ours = cv2.imread(str(session / "dataset" / NAME / "screen.png")).astype(float)
    theirs = cv2.imread(str(made / "dataset" / "session0_center" / "screen.png")).astype(float)
    assert np.abs(ours - theirs).mean() < 3


def test_its_lanes_are_those_that_traffic_drives_on(made: Path, session: Path) -> None:
    mine, theirs = (
        load_pickle(folder / "gt_data.pkl")
        for folder in (session / "dataset" / NAME, made / "dataset" / "session0_center")
    )
    camera = Camera.load(made / f"{NAME}.calibration.json", image_wh=SIZE)

    def borders(gt: dict) -> np.ndarray:
        points = [np.cross(line, gt["measurementLines"][0]) for line in gt["laneDivLines"]]
        return camera.road_points(np.array([p[:2] / p[2] for p in points]))[:, 1]

    assert len(mine["measurementLines"]) == 3
    assert len(mine["laneDivLines"]) >= 2
    off = np.abs(borders(mine)[:, None] - borders(theirs)).min(axis=1)
    assert off.max() < 0.5
    tracks = json.loads((session / "truth" / NAME / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    assert {t["heading"] for t in tracks if t["lane"] is not None} == {-1}


def test_its_masks_lie_in_their_boxes(session: Path) -> None:
    agreement = check_session(session / "dataset" / NAME)
    assert len(agreement["kind"]) > 10
    assert np.mean(agreement["inside"] >= 0.995) > 0.98
    assert np.mean(agreement["outline"] <= 2) > 0.98


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--replay"], "no recorded traffic"),
        (["--sun", "high"], "expected HEIGHT,RIGHT"),
        (["--sun", "95,0"], "expected HEIGHT,RIGHT"),
        (["--plates", "pink"], "use one of european"),
        (["--road-mask", "nowhere.png"], "no road mask at nowhere.png (option --road-mask)"),
        (["--calibration", "nowhere.json"], "no calibration at nowhere.json (option --calibration)"),
    ],
)
def test_wrong_options_give_one_line(
    made: Path, tmp_path: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["synth", "session", "--scene", str(made / f"{NAME}.avi"), "--out", str(tmp_path), *more])
    assert stop.value.code == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


def test_sharpening_can_be_taken_back() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(1).integers(60, 200, (80, 100, 3)).astype(np.uint8), (0, 0), 1.5)
    sensor = Sensor(sharpen=1.4)
    before = sensor.unsharpened(picture)
    assert before.std() < picture.std()
    assert np.abs(sensor.sharpened(before.astype(np.float32), 100) - picture).mean() < 1.5
    assert (PLAIN.unsharpened(picture) == picture).all()


def test_a_mask_of_another_size_is_refused(made: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.full((90, 160), 255, np.uint8))
    with VideoWriter(tmp_path / "short.avi", 10, SIZE) as writer:
        for frame in frames_of(made / f"{NAME}.avi")[:10]:
            writer.write(frame)
    calibration = made / f"{NAME}.calibration.json"
    with pytest.raises(DataError, match="160x90, but the video has 480x270"):
        write_session(
            tmp_path,
            scene=tmp_path / "short.avi",
            road_mask=tmp_path / "small.png",
            calibration=calibration,
        )


@pytest.fixture(scope="module")
def sunny() -> tuple[RoadScene, Footage, Renderer]:
    """A road in the sun, frames of its traffic, and what rendered them."""
    camera = look_at_road(9.0, (24.0, 0.4), 570.0, SIZE)
    scene = procedural_scene(np.random.default_rng(2), SIZE, heading=-1, seen_from=(camera, 0.0))
    light = make_light(Weather.DAY, np.random.default_rng(0))
    light = replace(light, sun_direction=np.array([0.5, 0.45, 0.75]) / np.linalg.norm([0.5, 0.45, 0.75]))
    background = draw_road(scene, light, np.random.default_rng(3))
    scene = replace(scene, background=background)
    renderer = Renderer(camera, background, light, seed=0)
    trips = random_traffic(scene, 40, 5, per_minute=14, kinds=["hatchback", "estate", "suv"])
    vehicles = {trip.track_id: trip.vehicle(lamps=False) for trip in trips}
    frames = []
    for number in range(30):
        time_s = 1.25 * number
        spans = {trip.track_id: trip.span_s((2.0, 60.0)) for trip in trips}
        visible = [trip for trip in trips if spans[trip.track_id][0] <= time_s <= spans[trip.track_id][1]]
        placed = [place(trip, vehicles[trip.track_id], time_s) for trip in visible]
        frames.append(renderer.frame(placed, number=number)[0])
    stack = np.stack(frames)
    return scene, Footage("made", 25.0, stack, stack[:4], background, 0.0, None), renderer


def test_the_sun_is_found_from_shadows(sunny: tuple[RoadScene, Footage, Renderer]) -> None:
    scene, footage, renderer = sunny
    shadows = find_shadows(footage, scene.camera, scene.road_mask)
    assert shadows.sunny
    assert shadows.left is not None
    light = renderer.light
    shade = light.grey_levels(light.road * light.ambient).mean() / light.grey_levels(light.road_radiance).mean()
    assert abs(shadows.left - shade) < 0.17
    assert shadows.sun is not None
    assert np.degrees(np.arccos(shadows.sun @ light.sun_direction)) < 22


def test_a_vehicle_put_into_a_picture_changes_its_surroundings_alone(
    sunny: tuple[RoadScene, Footage, Renderer],
) -> None:
    scene, _, renderer = sunny
    assert scene.background is not None
    sensor = Sensor(sharpen=1.2, smear=0.004, in_picture=True)
    light = replace(renderer.light, noise=0.0)
    into_picture = Renderer(scene.camera, scene.background, light, seed=0, sensor=sensor)
    trip = random_traffic(scene, 60, 5, per_minute=6, kinds=["hatchback"])[3]
    image, drawn = into_picture.frame([place(trip, trip.vehicle(lamps=False), trip.time_at(20.0))])
    assert len(drawn) == 1
    columns = np.flatnonzero((image != scene.background).any(axis=(0, 2)))
    assert 0 < len(columns) < 0.6 * SIZE[0]


def test_lanes_need_room_and_traffic() -> None:
    scene = procedural_scene(np.random.default_rng(2), SIZE, heading=-1)
    empty = np.full((270, 480, 3), 90, np.uint8)
    with pytest.raises(DataError, match="give it"):
        find_lanes(scene.camera, scene.road_mask, empty, [], None)
    lanes, borders = find_lanes(scene.camera, scene.road_mask, empty, [], 1)
    assert all(lane.heading == 1 for lane in lanes)
    assert len(borders) == len(lanes) + 1
    narrow = np.zeros((270, 480), bool)
    narrow[225:, 238:240] = True
    with pytest.raises(DataError, match="no room for a lane"):
        find_lanes(scene.camera, narrow, empty, [], 1)
