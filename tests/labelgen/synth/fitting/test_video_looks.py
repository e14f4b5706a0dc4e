"""What makes drawn vehicles look like those of a video: its recorder's blocks and calm, its tint, its empty road."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.footage import codec_of, read_footage, usual_packet
from labelgen.synth.fitting.lighting import fit_to_details, fit_to_tones, tones_of
from labelgen.synth.fitting.panel_noise import fit_to_panels, panel_noise
from labelgen.synth.fitting.sensor import block_step_of
from labelgen.synth.renderer.vehicle_shadows import shadow_colours
from labelgen.synth.sensor.compression_artifacts import add_block_artifacts
from labelgen.synth.sensor.noise import NoiseModel
from labelgen.synth.sensor.sensor import Sensor
from labelgen.synth.shading.lighting import Weather, make_light


def panels(level: float, noise: float, count: int = 8) -> list:
    """`count` even parts of vehicles, and which of their pixels count."""
    rng = np.random.default_rng(0)
    images = (level + rng.normal(0, noise, (count, 60, 80, 1))).clip(0, 255).repeat(3, axis=3).astype(np.uint8)
    return [(image, np.ones((60, 80), bool)) for image in images]


@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_noise_is_found_on_even_panels(noise: float) -> None:
    noise_model = NoiseModel((8.0,) * 9, (2.0,) * 9, 0.0, 0.0)
    found = panel_noise(panels(128, noise), 9)
    assert np.isnan(found).tolist() == [k != 4 for k in range(9)]
    shares = fit_to_panels(noise_model, panels(128, noise)).on_vehicles
    assert 8 * shares[4] == pytest.approx(noise, rel=0.25)
    assert (np.diff(shares[4:]) >= 0).all()
    assert max(shares) <= 1


def test_without_vehicles_the_noise_stays_what_it_is() -> None:
    noise_model = NoiseModel((8.0,) * 9, (2.0,) * 9, 0.0, 0.0)
    assert fit_to_panels(noise_model, panels(128, 3, count=2)) == noise_model


def test_vehicles_get_their_share_of_the_noise() -> None:
    noise_model = NoiseModel((8.0,) * 9, (2.0,) * 9, 0.0, 0.0, (0.25,))
    image = np.full((120, 160, 3), 128, np.uint8)
    vehicles = np.zeros((120, 160), bool)
    vehicles[:, 80:] = True
    noise_model.add(image, noise_model.tile((160, 120), np.random.default_rng(0)), 0, vehicles)
    grey = image.astype(float) @ [0.114, 0.587, 0.299]
    assert grey[:, 80:].std() == pytest.approx(0.25 * grey[:, :80].std(), rel=0.15)


def test_blocks_are_coarse_where_something_moves_and_nowhere_else() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (90, 110, 3)).astype(np.uint8), (0, 0), 1.0)
    moving = np.zeros((90, 110), bool)
    moving[40:48, 56:64] = True
    coarse = add_block_artifacts(image, moving, 12.0)
    off = np.abs(coarse.astype(int) - image).max(axis=2)
    assert off[40:48, 56:64].max() > 4
    assert off[:20].max() == off[:, :30].max() == off[70:].max() == off[:, 84:].max() == 0
    coarser = np.abs(add_block_artifacts(image, moving, 40.0).astype(int) - image).max(axis=2)
    assert coarser[40:48, 56:64].mean() > 1.4 * off[40:48, 56:64].mean()


@pytest.mark.parametrize("quantiser", [4, 9])
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
    size = usual_packet(path)
    assert size is not None
    assert codec_of(path) == "mpeg4"
    assert codec_of(tmp_path / "none.avi") == ""
    assert block_step_of(frames, 10, size) == pytest.approx(2 * quantiser, rel=0.25)


def test_only_old_recorders_are_given_coarser_blocks() -> None:
    fine, plain = tones_of(panels(128, 20)), tones_of(panels(128, 0.6))
    assert fine is not None
    assert plain is not None
    wanted, drawn = replace(fine, fine=1.4), replace(plain, fine=0.7)
    for step, coarsest in ((0.0, 0.0), (10.0, 17.0)):
        measured = Sensor(sharpen=0.2, block_step=step)
        assert step <= fit_to_details(measured, measured, wanted, drawn).block_step <= coarsest


def test_pale_panels_get_the_videos_tint() -> None:
    real, drawn = tones_of(panels(190, 2)), tones_of(panels(190, 2))
    assert real is not None
    assert drawn is not None
    light = make_light(Weather.OVERCAST, np.random.default_rng(0))
    tinted = fit_to_tones(light, replace(real, cast=(2.0, -10.0)), replace(drawn, cast=(2.0, 4.0)))
    red, green, blue = tinted.balance
    assert red < green == pytest.approx(blue)
    assert fit_to_tones(light, replace(real, cast=(0.0, 0.0)), drawn).balance == (1, 1, 1)
    white = tinted.grey_levels(np.full(3, 0.3)) / replace(tinted, balance=(1, 1, 1)).grey_levels(np.full(3, 0.3))
    np.testing.assert_allclose(white, tinted.balance, rtol=1e-5)


def test_shadows_have_the_skys_colour_and_the_depth_that_was_asked_for() -> None:
    left = shadow_colours(make_light(Weather.DAY, np.random.default_rng(0)))
    np.testing.assert_allclose(left[255], 1, atol=0.01)
    np.testing.assert_allclose(left.mean(axis=1)[20:], np.arange(20, 256) / 255, atol=0.02)
    blue, _, red = left[90]
    assert blue > red


def test_what_stood_on_the_road_for_long_leaves_no_specks(tmp_path: Path) -> None:
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
    empty = read_footage(tmp_path / "bus.avi").empty.astype(int)
    assert (np.ptp(empty[30:90, 20:70], axis=2) > 40).mean() < 0.05
    assert np.abs(empty[:, 77:83] - 200).mean() < 4
