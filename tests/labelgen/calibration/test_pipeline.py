"""Whole videos, drawn: calibrated where that is possible, refused with the reason where it is not."""

import json

import numpy as np
import pytest
from drawn_roads import DrawnVideo, Mover, bend, crossing, make_camera, straight, traffic, write_video

from labelgen.calibration.confidence import CalibrationRefusedError, Reason
from labelgen.calibration.pipeline import calibrate_video
from labelgen.geometry.camera import look_at_road

pytestmark = pytest.mark.slow

BOTH_WAYS = [(3.0, -22.0), (6.5, -25.0), (10.0, 20.0)]


def angle_deg(camera, true):
    a, b = (np.array([*(c.vp1 - true.pp), true.focal]) for c in (camera, true))
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


@pytest.mark.slow
def test_traffic_both_ways_calibrates():
    video = DrawnVideo(traffic(14, BOTH_WAYS), 14)
    done = calibrate_video(video)
    true = video.camera_at(0)
    assert angle_deg(done.camera, true) < 0.4
    assert done.camera.focal == pytest.approx(true.focal, rel=0.06)
    tilts = [np.degrees(np.arctan2(*(c.vp2 - c.vp1)[::-1]) + np.pi / 2) % 180 - 90 for c in (done.camera, true)]
    assert tilts[0] == pytest.approx(tilts[1], abs=0.5)
    confidence = done.confidence()
    assert confidence["overall"] > 0.5
    assert confidence["doubts"] == []
    # The spreads are about the errors.
    assert angle_deg(done.camera, true) < 5 * confidence["vp1"]["spread_deg"] + 0.1
    # Silhouettes come from frames all over the video, in order of time.
    numbers = [silhouette.frame_number for silhouette in done.silhouettes]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) >= 20
    assert [s.time_s for s in done.silhouettes] == pytest.approx([number / 15 for number in numbers])
    assert done.observations.background is not None
    # The empty scene is empty.
    empty = DrawnVideo([], 1).draw(0).astype(float)[..., ::-1]
    assert np.abs(done.observations.background - empty).mean() < 6


def _panning(time_s):
    return look_at_road(9.0, (30.0, 6.0 + 1.2 * time_s), 620.0, (640, 360), 1.0)


def _both_directions(seconds):
    across = [
        Mover(crossing(s, x, 15.0), seed=k) for x in (25.0, 40.0) for k, s in enumerate(np.arange(-2, seconds, 2.2))
    ]
    return traffic(seconds, BOTH_WAYS[:2], 2.5) + across


def _round_a_bend(seconds):
    starts = np.arange(-3, seconds, 1.6)
    return [Mover(bend(s, y, 18.0, 150.0), seed=k) for y in (0.0, 4.0) for k, s in enumerate(starts)]


def _bend_camera(time_s):
    return make_camera(9.0, (30.0, -4.0))


REFUSED = {
    Reason.NOTHING_MOVES: lambda: DrawnVideo([], 4),
    Reason.TOO_FEW_VEHICLES: lambda: DrawnVideo([Mover(straight(0, 6.0, -20.0))], 5),
    Reason.MOVING_CAMERA: lambda: DrawnVideo(traffic(5, BOTH_WAYS), 5, camera_at=_panning),
    Reason.CURVED_ROAD: lambda: DrawnVideo(_round_a_bend(9), 9, camera_at=_bend_camera),
    Reason.NO_COMMON_DIRECTION: lambda: DrawnVideo(_both_directions(9), 9),
    Reason.NO_PERPENDICULAR_EDGES: lambda: DrawnVideo(traffic(9, BOTH_WAYS, ball=True), 9),
}


@pytest.mark.slow
@pytest.mark.parametrize("reason", list(Reason), ids=lambda reason: reason.value.replace(" ", "-"))
def test_each_reason_to_refuse_is_given(reason):
    with pytest.raises(CalibrationRefusedError) as caught:
        calibrate_video(REFUSED[reason]())
    assert caught.value.reason is reason
    assert f"drawn: {reason.value}" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_command_writes_calibration_picture_and_report(labelgen, tmp_path):
    video = write_video(tmp_path / "road.mp4", DrawnVideo(traffic(10, BOTH_WAYS), 10))
    done = labelgen("calibrate", video, "--picture", "road.png", "--json", "report.json")
    assert done.returncode == 0, done.stderr
    data = json.loads((tmp_path / "road.calibration.json").read_text())
    assert set(data) == {"camera_calibration", "cars", "confidence", "image_wh"}
    assert {"overall", "vp1", "vp2", "focal", "doubts"} <= set(data["confidence"])
    assert (tmp_path / "road.png").stat().st_size > 10000
    assert json.loads((tmp_path / "report.json").read_text())["focal"] == pytest.approx(620, rel=0.1)
    assert "VP1, px" in done.stdout
    # Nothing is replaced without being told to, and that is said before the work.
    again = labelgen("calibrate", video)
    assert again.returncode == 2
    assert "add --overwrite" in again.stderr


@pytest.mark.slow
def test_the_command_refuses_with_one_line_and_code_2(labelgen, tmp_path):
    video = write_video(tmp_path / "empty.mp4", DrawnVideo([], 3))
    done = labelgen("calibrate", video)
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("labelgen: error: empty: nothing moves")
    assert not (tmp_path / "empty.calibration.json").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["no.mp4"], "no such file"),
        (["clip.mp4", "--picture", "p.gif"], "name a .png or .jpg file"),
        (["clip.mp4", "--out", "."], "it is a folder"),
        (["clip.mp4", "--pp", "1;2"], "expected two numbers X,Y"),
    ],
)
def test_bad_arguments_are_one_line(labelgen, tmp_path, arguments, message):
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    done = labelgen("calibrate", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "vp1"), [("city_road_640x360.mp4", True), ("freeway_320x240.avi", True), ("motorway_848x478.mp4", False)]
)
def test_real_roads_calibrate(real_data, name, vp1):
    path = real_data / "videos" / name
    done = calibrate_video(path)
    assert 0.4 < done.camera.focal / done.observations.size_wh[0] < 5
    if vp1:
        from labelgen.geometry import Camera

        by_hand = Camera.load(path.with_suffix("").with_suffix(".calibration.json"))
        assert angle_deg(done.camera, by_hand) < 3


@pytest.mark.slow
def test_the_real_crossing_is_refused(real_data):
    with pytest.raises(CalibrationRefusedError, match="no common direction"):
        calibrate_video(real_data / "videos" / "crossing_640x480.mp4")
