"""The road from tracks of what moves."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from speed_scenes import make_camera

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.calibration.road_mask import estimate_road_mask
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, Pair, Rectification


def drive(camera: Camera, y_m: float, start_m: float, end_m: float, *, height_m: float = 0.5) -> Track:
    x = np.linspace(start_m, end_m, 12)
    points = camera.project(np.stack([x, np.full(12, y_m), np.full(12, height_m)], axis=1))
    assert camera.image_wh is not None
    inside = ((points > 0) & (points < camera.image_wh)).all(axis=1)
    return Track(np.arange(12.0)[inside], points[inside])


def traffic(camera: Camera, low_m: float, high_m: float, *, away: bool = False, count: int = 150) -> list[Track]:
    rng = np.random.default_rng(0)
    out = []
    for y in rng.uniform(low_m, high_m, count):
        near, far = rng.uniform(16, 25), rng.uniform(45, 70)
        out.append(drive(camera, y, *((near, far) if away else (far, near))))
    return out


def band(camera: Camera, low_m: float, high_m: float) -> np.ndarray:
    """(H, W) bool, the road between two distances from the camera's foot line, 20 to 60 m ahead."""
    assert camera.image_wh is not None
    corners = camera.project([[20.0, low_m], [20.0, high_m], [60.0, high_m], [60.0, low_m]])
    out = np.zeros(camera.image_wh[::-1], np.uint8)
    cv2.fillConvexPoly(out, np.round(corners).astype(np.int32), 1)
    return out > 0


def iou(one: np.ndarray, two: np.ndarray) -> float:
    return float((one & two).sum() / (one | two).sum())


@pytest.mark.parametrize("factor", [1 / 3, 1.0])
@pytest.mark.parametrize("away", [False, True])
def test_the_road_is_where_traffic_runs(away: bool, factor: float) -> None:
    camera = make_camera(factor)
    road = estimate_road_mask(replace(camera, scale=None), traffic(camera, -5.5, 5.5, away=away))
    assert road.pixels.shape == (camera.image_wh[1], camera.image_wh[0])  # type: ignore[index]
    rows = band(camera, -40.0, 40.0)
    assert iou(road.pixels & rows, band(camera, -5.5, 5.5)) > 0.85
    assert road.along == 1.0
    for pair in Pair:
        Rectification.from_road_mask(camera, road.pixels, pair, (480, 270))


def test_two_directions_are_two_carriageways() -> None:
    camera = make_camera()
    tracks = [*traffic(camera, 4.0, 9.0), *traffic(camera, -9.0, -4.0, away=True)]
    road = estimate_road_mask(camera, tracks).pixels
    for y, expected in ((6.5, True), (0.0, False), (-6.5, True)):
        column, row = camera.project([30.0, y]).astype(int)
        assert road[row, column] == expected, y


def test_what_crosses_the_road_does_not_widen_it() -> None:
    camera = make_camera()
    across = []
    for x in np.linspace(20, 60, 30):
        points = camera.project(np.stack([np.full(20, x), np.linspace(-12, 12, 20)], axis=1))
        across.append(Track(np.arange(20.0), points))
    road = estimate_road_mask(camera, [*traffic(camera, -4.0, 4.0), *across])
    assert road.along == pytest.approx(150 / 180)
    rows = band(camera, -40.0, 40.0)
    assert iou(road.pixels & rows, band(camera, -4.0, 4.0)) > 0.8


def test_refusals() -> None:
    camera = make_camera()
    standing = [Track(np.arange(5.0), np.full((5, 2), 500.0))] * 30
    horizon_tangent = [Track(np.arange(2.0), np.array([[x, 700.0], [x + 300.0, 700.0]])) for x in range(100, 130)]
    for tracks, reason in (
        ([], r"nothing moves along VP1 \(0 of 0 tracks"),
        (standing, "nothing moves along VP1"),
        (horizon_tangent, r"nothing moves along VP1 \(0 of 30 tracks"),
        (traffic(camera, -1.0, 1.0, count=4), r"too little moves along VP1 \(4 of 4 tracks"),
    ):
        with pytest.raises(CalibrationError, match=f"road mask: {reason}") as refusal:
            estimate_road_mask(camera, tracks)
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.mp4", "--out", "m.png"], "none.mp4: no such file"),
        (["there.txt", "--out", "m.jpg"], "--out m.jpg: name a .png file"),
        (["there.txt", "--out", "there.png"], "--out there.png: it exists; add --overwrite"),
        (["there.txt", "--out", "m.png"], "there.txt"),
    ],
)
def test_command_errors(
    labelgen: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path, arguments: list[str], message: str
) -> None:
    (tmp_path / "there.txt").write_text("no video")
    (tmp_path / "there.png").write_bytes(b"")
    done = labelgen("road-mask", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "m.png").exists()
