"""The tools that measure calibrations."""

import json

import numpy as np
import pytest
from drawn_roads import DrawnVideo, make_camera, traffic, write_video
from typer.testing import CliRunner

from labelgen.geometry import Camera
from tools.benchmarks.calibrate import measure, recode
from tools.studies.calibration import angle_deg, app, tilt_deg

pytestmark = pytest.mark.slow


def test_tracks_table_of_the_real_recordings(real_data):
    shown = CliRunner().invoke(app, ["tracks", str(real_data / "brnocompspeed")]).output
    rows = {line.split(" | ")[0].strip("| "): line for line in shown.splitlines() if line.startswith("| session")}
    assert len(rows) == 10
    # The two doubtful recordings: found VP1s explain the surveyed distances several times better.
    for name in ("session1_center", "session1_right"):
        ours, theirs = (float(cell.split()[0]) for cell in rows[name].split("|")[5:7])
        assert ours < 2 < 6 < theirs
    assert "of 10" in shown


def test_angles_and_tilts():
    camera = make_camera(roll_deg=2.0)
    assert angle_deg(camera.vp1, camera.vp1, camera) == pytest.approx(0, abs=1e-5)
    assert angle_deg(camera.vp1, camera.vp2, camera) == pytest.approx(90)
    mirrored = Camera(camera.vp2, camera.vp1, camera.pp)
    assert tilt_deg(mirrored) == pytest.approx(tilt_deg(camera))


@pytest.mark.slow
def test_benchmark_measures_a_video_written_anew(tmp_path):
    short = write_video(tmp_path / "short.mp4", DrawnVideo(traffic(3, [(3.0, -22.0), (8.0, 20.0)], 0.8), 3))
    recode(short, tmp_path / "long.mp4", (320, 180), 15, 6.0)
    figures = measure(tmp_path / "long.mp4")
    assert figures["seconds"] == pytest.approx(6, abs=0.3)
    assert figures["times_real_time"] > 0
    assert sum(figures["share_percent"].values()) == pytest.approx(100)
    assert np.isfinite(json.loads(json.dumps(figures))["cpu_s"])
