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
from labelgen.synth.fitting.footage import Footage, read_footage
from labelgen.synth.fitting.lanes import find_lanes
from labelgen.synth.fitting.lighting import fit_to_shadows, fit_to_tones, footage_parts, tones_of
from labelgen.synth.fitting.sun import Shadows, find_shadows
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.scene.road_image import draw_road
from labelgen.synth.scene.scene import Scene, procedural_scene
from labelgen.synth.scene.traffic import random_traffic
from labelgen.synth.sensor.sensor import PLAIN, Sensor
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.truth.check import check_session
from labelgen.synth.truth.session import place, write_session

SIZE = (640, 360)
NAME = "own"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with own.avi and what belongs to it, and the session it comes from."""
    root = tmp_path_factory.mktemp("made")
    write_session(
        root, duration_s=40, fps=10, size_wh=SIZE, seed=21, weather=Weather.OVERCAST, heading=-1, per_minute=14,
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
    arguments = ["session", "--scene", str(made / f"{NAME}.avi"), "--out", str(out), "--duration", "3", "--seed", "1"]
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
    assert len(frames) == 30
    assert frames[0].shape == (360, 640, 3)


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
    found = check_session(session / "dataset" / NAME)
    assert len(found["kind"]) > 10
    assert np.mean(found["inside"] >= 0.995) > 0.98
    assert np.mean(found["outline"] <= 2) > 0.98


def test_the_same_seed_gives_the_same_frames(made: Path, session: Path, tmp_path: Path) -> None:
    write_session(tmp_path, scene=made / f"{NAME}.avi", duration_s=1, seed=1, plates="blue")
    ours, theirs = (frames_of(p / "dataset" / NAME / "video.avi") for p in (tmp_path, session))
    assert all((a == b).all() for a, b in zip(ours[:8], theirs[:8], strict=True))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--replay"], "no recorded traffic"),
        (["--sun", "high"], "expected HEIGHT,RIGHT"),
        (["--sun", "95,0"], "expected HEIGHT,RIGHT"),
        (["--heading", "north"], "use away or closer"),
        (["--plates", "pink"], "use one of european"),
        (["--road-mask", "nowhere.png"], "no road mask at --road-mask"),
        (["--calibration", "nowhere.json"], "no calibration at --calibration"),
    ],
)
def test_what_cannot_be_is_one_line(
    made: Path, tmp_path: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["synth", "session", "--scene", str(made / f"{NAME}.avi"), "--out", str(tmp_path), *more])
    assert stop.value.code == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


def test_a_mask_of_another_size_is_told(made: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.full((90, 160), 255, np.uint8))
    with pytest.raises(DataError, match="160x90, but the video has 640x360"):
        write_session(tmp_path, scene=made / f"{NAME}.avi", road_mask=tmp_path / "small.png")


def test_a_video_too_short_to_show_the_road_is_told(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "short.avi", 10, SIZE) as writer:
        for _ in range(3):
            writer.write(np.zeros((360, 640, 3), np.uint8))
    with pytest.raises(DataError, match="too few to see the empty road"):
        read_footage(tmp_path / "short.avi")


def test_a_swaying_picture_is_held_still_and_its_traffic_taken_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (400, 700, 3)).astype(np.uint8), (0, 0), 3)
    wide = cv2.normalize(wide, None, 20, 235, cv2.NORM_MINMAX)
    with VideoWriter(tmp_path / "sway.avi", 10, SIZE, 12) as writer:
        for k in range(40):
            dx, dy = round(6 * np.sin(k / 5)), round(4 * np.cos(k / 7))
            frame = np.ascontiguousarray(wide[20 + dy : 380 + dy, 30 + dx : 670 + dx])
            cv2.rectangle(frame, (14 * k, 150), (14 * k + 90, 220), (0, 0, 200 + k), -1)
            writer.write(frame)
    footage = read_footage(tmp_path / "sway.avi")
    assert 3 < footage.shake_px < 10
    dx, dy = round(6 * np.sin(20 / 5)), round(4 * np.cos(20 / 7))
    still = wide[20 + dy : 380 + dy, 30 + dx : 670 + dx].astype(float)
    inner = np.s_[20:-20, 30:-30]
    assert np.abs(footage.empty[inner] - still[inner]).mean() < 4


def shadow_scene(sun: list[float]) -> tuple[Scene, Footage, Renderer]:
    """A road in the sun and frames of its traffic."""
    camera = look_at_road(9.0, (24.0, 0.4), 760.0, SIZE)
    scene = procedural_scene(np.random.default_rng(2), SIZE, heading=-1, seen_from=(camera, 0.0))
    light = make_light(Weather.DAY, np.random.default_rng(0))
    light = replace(light, sun_direction=np.array(sun) / np.linalg.norm(sun))
    background = draw_road(scene, light, np.random.default_rng(3))
    scene = replace(scene, background=background)
    renderer = Renderer(camera, background, light, seed=0)
    trips = random_traffic(scene, 80, 5, per_minute=14, kinds=["hatchback", "estate", "suv"])
    looks = []
    for number in range(40):
        here = [t for t in trips if t.span_s((2.0, 60.0))[0] <= 2 * number <= t.span_s((2.0, 60.0))[1]]
        looks.append(renderer.frame([place(t, t.vehicle(lamps=False), 2.0 * number) for t in here], number=number)[0])
    stack = np.stack(looks)
    return scene, Footage("made", 25.0, stack, stack[:4], background, 0.0, None), renderer


@pytest.mark.parametrize("sun", [[0.5, 0.45, 0.75], [-0.3, -0.6, 0.75]])
def test_the_sun_is_found_from_shadows(sun: list[float]) -> None:
    scene, footage, renderer = shadow_scene(sun)
    shadows = find_shadows(footage, scene.camera, scene.road_mask)
    assert shadows.sunny
    assert shadows.left is not None
    light = renderer.light
    shade = light.grey_levels(light.road * light.ambient).mean() / light.grey_levels(light.road_radiance).mean()
    assert abs(shadows.left - shade) < 0.17
    assert shadows.sun is not None
    assert np.degrees(np.arccos(shadows.sun @ light.sun_direction)) < 22


def test_a_sky_as_bright_as_shadows_say() -> None:
    light = make_light(Weather.DAY, np.random.default_rng(0))
    deep, soft = (fit_to_shadows(light, Shadows(left, None, 0)) for left in (0.3, 0.6))
    np.testing.assert_allclose(deep.road_radiance.mean(), light.road_radiance.mean(), rtol=0.01)
    assert deep.ambient.mean() < soft.ambient.mean() < light.road_radiance.mean() / light.road.mean()


def test_lanes_need_room_and_traffic() -> None:
    scene = procedural_scene(np.random.default_rng(2), SIZE, heading=-1)
    empty = np.full((360, 640, 3), 90, np.uint8)
    with pytest.raises(DataError, match="give --heading"):
        find_lanes(scene.camera, scene.road_mask, empty, [], None)
    lanes, borders = find_lanes(scene.camera, scene.road_mask, empty, [], 1)
    assert all(lane.heading == 1 for lane in lanes)
    assert len(borders) == len(lanes) + 1
    narrow = np.zeros((360, 640), bool)
    narrow[300:, 318:321] = True
    with pytest.raises(DataError, match="no room for a lane"):
        find_lanes(scene.camera, narrow, empty, [], 1)


def test_tones_are_brought_nearer_to_those_of_the_video() -> None:
    rng = np.random.default_rng(0)

    def vehicles(low: int, high: int) -> list:
        return [(rng.integers(low, high, (40, 40, 3)).astype(np.uint8), np.ones((40, 40), bool)) for _ in range(8)]

    real, drawn = tones_of(vehicles(60, 160)), tones_of(vehicles(5, 250))
    assert real is not None
    assert drawn is not None
    assert tones_of(vehicles(0, 9)[:2]) is None
    light = fit_to_tones(make_light(Weather.DAY, rng), real, drawn)
    levels, made = zip(*light.tone, strict=True)
    assert (np.diff(made) >= 0).all()
    assert 35 < np.interp(drawn.grey[0], levels, made) < 95
    assert 130 < np.interp(drawn.grey[-1], levels, made) < 200


def test_shadows_are_no_vehicles() -> None:
    """A black car has lamps; the core of a shadow below a car is as black and has none."""
    empty = np.full((200, 300, 3), 120, np.uint8)
    look = empty.copy()
    look[50:110, 40:110] = 12  # a car, with lamps and a plate
    look[86:104, 43:107] = 150
    look[50:110, 180:250] = 12  # what lies below another
    noise = np.random.default_rng(0).integers(-3, 4, look.shape)
    look = np.clip(look + noise, 0, 255).astype(np.uint8)
    footage = Footage("x", 25.0, look[None], look[None], empty, 0.0, None)
    road = np.ones((200, 300), bool)
    parts = list(footage_parts(footage, road, Shadows(0.35, np.array([0.5, 0.5, 0.7]), 5)))
    assert len(parts) == 1
    assert parts[0][0].max() > 120
    assert len(list(footage_parts(footage, road, Shadows(None, None, 0)))) == 2


def test_the_foot_of_a_vehicle_does_not_darken_the_picture() -> None:
    image = np.full((40, 60, 3), 130, np.uint8)
    image[31:] = 5
    tones = tones_of([(image, np.ones((40, 60), bool))] * 8)
    assert tones is not None
    assert tones.grey[0] == 130


def test_sharpening_can_be_taken_back() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(1).integers(60, 200, (80, 100, 3)).astype(np.uint8), (0, 0), 1.5)
    sensor = Sensor(sharpen=1.4)
    before = sensor.unsharpened(picture)
    assert before.std() < picture.std()
    assert np.abs(sensor.sharpened(before.astype(np.float32), 100) - picture).mean() < 1.5
    assert (PLAIN.unsharpened(picture) == picture).all()


def test_what_is_put_into_a_picture_leaves_the_rest_as_it_is() -> None:
    scene, _, renderer = shadow_scene([0.5, 0.45, 0.75])
    assert scene.background is not None
    ours = Renderer(
        scene.camera, scene.background, replace(renderer.light, noise=0.0), seed=0,
        sensor=Sensor(sharpen=1.2, smear=0.004, in_picture=True),
    )  # fmt: skip
    trip = random_traffic(scene, 60, 5, per_minute=6, kinds=["hatchback"])[3]
    time_s = trip.time_at(20.0)
    image, drawn = ours.frame([place(trip, trip.vehicle(lamps=False), time_s)])
    assert len(drawn) == 1
    changed = (image != scene.background).any(axis=2)
    columns = np.flatnonzero(changed.any(axis=0))
    assert 0 < len(columns) < 0.6 * SIZE[0]
