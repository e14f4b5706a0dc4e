"""Noise, sharpness and compression of a simulated camera are measured again."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.footage import codec_of, mean_packet_bytes
from labelgen.synth.fitting.panel_noise import fit_to_panels, panel_noise
from labelgen.synth.fitting.sensor import edge_profile, estimate_block_step, estimate_crf, fit_edges, measure_noise
from labelgen.synth.sensor.noise import NoiseModel
from labelgen.synth.sensor.sensor import Sensor

LEVELS = np.linspace(0, 255, 9)


def stripes() -> np.ndarray:
    """(270, 360, 3) even bands of nine brightnesses."""
    return np.repeat(np.repeat(LEVELS.clip(12, 240).astype(np.uint8), 40)[None, :, None], 270, axis=0).repeat(3, axis=2)


@pytest.mark.parametrize("blur", [0.7])
def test_noise_comes_out_as_it_went_in(blur: float) -> None:
    noise_model = NoiseModel(tuple(np.linspace(1.5, 5, 9)), (1.0,) * 9, blur, blur)
    empty = stripes()
    tile = noise_model.tile((360, 270), np.random.default_rng(0))
    frames = np.repeat(empty[None], 16, axis=0)
    for number, frame in enumerate(frames):
        noise_model.add(frame, tile, number)
    flat = np.ones((270, 360), bool)
    for k in range(0, 361, 40):
        flat[:, max(0, k - 3) : k + 3] = False
    got = measure_noise(frames, empty, flat)
    np.testing.assert_allclose(got.grey[1:-1], noise_model.grey[1:-1], rtol=0.15)
    np.testing.assert_allclose(got.colour[1:-1], noise_model.colour[1:-1], rtol=0.25)
    assert abs(got.grey_px - blur) < 0.25


def test_no_still_part_means_no_noise() -> None:
    empty = stripes()
    other = np.where(empty < 128, empty + 100, empty - 100).astype(np.uint8)
    got = measure_noise(np.stack([other] * 3), empty, np.ones((270, 360), bool))
    assert set(got.grey) == {0.0}


@pytest.mark.parametrize(("blur", "sharpen"), [(0.6, 1.2), (1.4, 0.0)])
def test_blur_and_halos_come_out_as_they_went_in(blur: float, sharpen: float) -> None:
    large = np.full((1600, 2400), 70, np.float32)
    for k in range(12):
        angle = 0.15 + 0.5 * k
        box = cv2.boxPoints(((200 + 380 * (k % 6), 400 + 800 * (k // 6)), (230, 300), np.degrees(angle)))
        cv2.fillConvexPoly(large, box.astype(np.int32), 150.0)
    small = cv2.resize(large, (600, 400), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(small, (0, 0), blur)
    image = Sensor(sharpen=sharpen).sharpened(np.repeat(image[..., None], 3, axis=2), 600)[..., 0]
    profile, count = edge_profile(image)
    assert count > 100
    assert abs(profile[len(profile) // 2] - 0.5) < 0.05
    got_blur, got_sharpen = fit_edges([image])
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
        size = mean_packet_bytes(path)
        assert size is not None
        got.append(estimate_crf(frames, 10, size))
    assert abs(got[0] - 18) <= 2
    assert abs(got[1] - 30) <= 2


def panels(level: float, noise: float, count: int = 8) -> list:
    """`count` even parts of vehicles, and which of their pixels count."""
    rng = np.random.default_rng(0)
    images = (level + rng.normal(0, noise, (count, 60, 80, 1))).clip(0, 255).repeat(3, axis=3).astype(np.uint8)
    return [(image, np.ones((60, 80), bool)) for image in images]


@pytest.mark.parametrize("noise", [3.0])
def test_noise_is_found_on_even_panels(noise: float) -> None:
    noise_model = NoiseModel((8.0,) * 9, (2.0,) * 9, 0.0, 0.0)
    measured = panel_noise(panels(128, noise), 9)
    assert np.isnan(measured).tolist() == [k != 4 for k in range(9)]
    shares = fit_to_panels(noise_model, panels(128, noise)).on_vehicles
    assert 8 * shares[4] == pytest.approx(noise, rel=0.25)
    assert (np.diff(shares[4:]) >= 0).all()
    assert max(shares) <= 1


def test_without_vehicles_the_noise_stays_what_it_is() -> None:
    noise_model = NoiseModel((8.0,) * 9, (2.0,) * 9, 0.0, 0.0)
    assert fit_to_panels(noise_model, panels(128, 3, count=2)) == noise_model


@pytest.mark.parametrize("quantiser", [9])
def test_an_old_recorders_rounding_is_found_from_its_bytes(tmp_path: Path, quantiser: int) -> None:
    scene = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (120, 400, 3)).astype(np.uint8), (0, 0), 1.2)
    frames = np.stack([scene[:, 3 * k : 3 * k + 160] for k in range(24)])
    path = tmp_path / "old.avi"
    with av.open(str(path), "w", format="avi") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.codec_context.qmin = stream.codec_context.qmax = quantiser
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
        container.mux(stream.encode(None))
    size = mean_packet_bytes(path)
    assert size is not None
    assert codec_of(path) == "mpeg4"
    assert codec_of(tmp_path / "none.avi") == ""
    assert estimate_block_step(frames, 10, size) == pytest.approx(2 * quantiser, rel=0.25)
