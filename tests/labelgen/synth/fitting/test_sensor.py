"""What is put into a camera comes out of its measurement: noise, sharpness, compression."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.sensor import edge_profile, fit_edges, measure_noise, quality_of, usual_packet
from labelgen.synth.sensor.noise import NoiseModel
from labelgen.synth.sensor.sensor import Sensor

LEVELS = np.linspace(0, 255, 9)


def stripes() -> np.ndarray:
    """(270, 360, 3) even bands of nine brightnesses."""
    return np.repeat(np.repeat(LEVELS.clip(12, 240).astype(np.uint8), 40)[None, :, None], 270, axis=0).repeat(3, axis=2)


@pytest.mark.parametrize("blur", [0.0, 0.7])
def test_noise_comes_out_as_it_went_in(blur: float) -> None:
    noise_model = NoiseModel(tuple(np.linspace(1.5, 5, 9)), (1.0,) * 9, blur, blur)
    empty = stripes()
    tile = noise_model.tile((360, 270), np.random.default_rng(0))
    looks = np.repeat(empty[None], 16, axis=0)
    for number, look in enumerate(looks):
        noise_model.add(look, tile, number)
    flat = np.ones((270, 360), bool)
    for k in range(0, 361, 40):
        flat[:, max(0, k - 3) : k + 3] = False
    got = measure_noise(looks, empty, flat)
    np.testing.assert_allclose(got.grey[1:-1], noise_model.grey[1:-1], rtol=0.15)
    np.testing.assert_allclose(got.colour[1:-1], noise_model.colour[1:-1], rtol=0.25)
    assert abs(got.grey_px - blur) < 0.25


def test_no_still_part_means_no_noise() -> None:
    empty = stripes()
    other = np.where(empty < 128, empty + 100, empty - 100).astype(np.uint8)
    got = measure_noise(np.stack([other] * 3), empty, np.ones((270, 360), bool))
    assert set(got.grey) == {0.0}


@pytest.mark.parametrize(("blur", "sharpen"), [(0.5, 0.0), (0.6, 1.2), (1.4, 0.0), (1.0, 0.9)])
def test_blur_and_halos_come_out_as_they_went_in(blur: float, sharpen: float) -> None:
    large = np.full((1600, 2400), 70, np.float32)
    for k in range(12):
        angle = 0.15 + 0.5 * k
        box = cv2.boxPoints(((200 + 380 * (k % 6), 400 + 800 * (k // 6)), (230, 300), np.degrees(angle)))
        cv2.fillConvexPoly(large, box.astype(np.int32), 150.0)
    small = cv2.resize(large, (600, 400), interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(small, (0, 0), blur)
    seen = Sensor(sharpen=sharpen).sharpened(np.repeat(seen[..., None], 3, axis=2), 600)[..., 0]
    profile, count = edge_profile(seen)
    assert count > 100
    assert abs(profile[len(profile) // 2] - 0.5) < 0.05
    got_blur, got_sharpen = fit_edges([seen])
    assert abs(got_blur - blur) < 0.3
    assert abs(got_sharpen - sharpen) < 0.5


def test_a_picture_without_edges_says_nothing() -> None:
    assert edge_profile(np.full((60, 80), 90, np.float32))[1] == 0
    assert fit_edges([np.full((60, 80), 90, np.float32)]) == (0.5, 0.0)


def test_the_quality_is_that_of_the_video(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 255, (120, 400, 3)).astype(np.uint8), (0, 0), 1.2)
    frames = np.stack([scene[:, 3 * k : 3 * k + 160] for k in range(24)])
    got = []
    for crf in (18, 30):
        path = tmp_path / f"{crf}.avi"
        with VideoWriter(path, 10, (160, 120), crf, preset="medium") as writer:
            for frame in frames:
                writer.write(np.ascontiguousarray(frame))
        size = usual_packet(path)
        assert size is not None
        got.append(quality_of(frames, 10, size))
    assert abs(got[0] - 18) <= 2
    assert abs(got[1] - 30) <= 2
