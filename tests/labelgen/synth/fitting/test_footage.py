"""Frames taken from a video: stabilised, and the empty road behind the traffic."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.footage import read_footage

pytestmark = pytest.mark.slow


def test_a_video_too_short_to_show_the_road_is_told(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "short.avi", 10, (320, 180)) as writer:
        for _ in range(3):
            writer.write(np.zeros((180, 320, 3), np.uint8))
    with pytest.raises(DataError, match="too few to see the empty road"):
        read_footage(tmp_path / "short.avi")


def test_a_swaying_picture_is_stabilised_and_its_traffic_taken_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (220, 380, 3)).astype(np.uint8), (0, 0), 3)
    wide = cv2.normalize(wide, None, 20, 235, cv2.NORM_MINMAX)
    with VideoWriter(tmp_path / "sway.avi", 10, (320, 180), 12) as writer:
        for k in range(30):
            dx, dy = round(6 * np.sin(k / 5)), round(4 * np.cos(k / 7))
            frame = np.ascontiguousarray(wide[20 + dy : 200 + dy, 30 + dx : 350 + dx])
            cv2.rectangle(frame, (10 * k, 70), (10 * k + 50, 110), (0, 0, 200 + k), -1)
            writer.write(frame)
    footage = read_footage(tmp_path / "sway.avi")
    assert 3 < footage.shake_px < 10
    dx, dy = round(6 * np.sin(15 / 5)), round(4 * np.cos(15 / 7))
    expected = wide[20 + dy : 200 + dy, 30 + dx : 350 + dx].astype(float)
    inner = np.s_[20:-20, 30:-30]
    assert np.abs(footage.background[inner] - expected[inner]).mean() < 4


def test_a_vehicle_that_stops_leaves_no_specks(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    road = np.full((120, 160, 3), 110, np.uint8)
    road[:, 76:84] = 200
    with VideoWriter(tmp_path / "bus.avi", 10, (160, 120), 10) as writer:
        for k in range(40):
            frame = (road + rng.normal(0, 2, road.shape)).clip(0, 255).astype(np.uint8)
            if k >= 15:  # it stands there for most of the time, painted in colours as bright as the road and not
                bus = frame[30:90, 20:70]
                bus[:] = (160, 110, 40)
                bus[rng.random(bus.shape[:2]) < 0.5] = (90, 60, 170)
            writer.write(frame)
    empty = read_footage(tmp_path / "bus.avi").background.astype(int)
    assert (np.ptp(empty[30:90, 20:70], axis=2) > 40).mean() < 0.05
    assert np.abs(empty[:, 77:83] - 200).mean() < 4
