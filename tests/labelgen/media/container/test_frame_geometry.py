"""Pixels that are not square, turned and mirrored pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from labelgen.media.container.frame_geometry import FrameGeometry

PICTURE = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def display(a: float, b: float, c: float, d: float) -> np.ndarray:
    """FFmpeg's matrix: x' = a x + c y, y' = b x + d y."""
    return np.array([[a, b, 0], [c, d, 0], [0, 0, 16384.0]])


@pytest.mark.parametrize(
    ("matrix", "expected", "words"),
    [
        (display(1, 0, 0, 1), PICTURE, ""),
        (display(0, 1, -1, 0), np.rot90(PICTURE, -1), "turned by 270 degrees"),
        (display(-1, 0, 0, -1), np.rot90(PICTURE, 2), "turned by 180 degrees"),
        (display(0, -1, 1, 0), np.rot90(PICTURE), "turned by 90 degrees"),
        (display(-1, 0, 0, 1), PICTURE[:, ::-1], "mirrored left to right"),
        (display(1, 0, 0, -1), PICTURE[::-1], "mirrored upside down"),
        (display(0, 1, 1, 0), PICTURE.swapaxes(0, 1), "mirrored"),
        (display(0, -1, -1, 0), np.rot90(PICTURE, 2).swapaxes(0, 1), "mirrored"),
        (display(0.5, 0, 0, 0.5), PICTURE, ""),
    ],
)
def test_turns_and_mirrors_move_pixels(matrix: np.ndarray, expected: np.ndarray, words: str) -> None:
    geometry = FrameGeometry.of((64, 48), None, matrix)
    np.testing.assert_array_equal(geometry.apply(PICTURE), expected)
    assert geometry.size_wh == (expected.shape[1], expected.shape[0])
    assert not geometry.resamples
    assert words in geometry.note
    assert bool(geometry.note) is bool(words)


@pytest.mark.parametrize(
    ("aspect", "width"),
    [(4 / 3, 85), (0.5, 32), (1.0, 64), (0, 64), (None, 64), (1.003, 64), (100, 64), (1e-9, 64)],
)
def test_pixels_become_square(aspect: float | None, width: int) -> None:
    geometry = FrameGeometry.of((64, 48), aspect, None)
    assert geometry.size_wh == (width, 48)
    ramp = np.repeat(np.repeat(np.arange(64, dtype=np.uint8)[None, :, None] * 3, 48, axis=0), 3, axis=2)
    out = geometry.apply(ramp)
    assert out.shape == (48, width, 3)
    places = (np.arange(width) + 0.5) / width * 64 - 0.5
    np.testing.assert_allclose(out[20, 2:-2, 0], 3 * places[2:-2], atol=1.6)
    assert geometry.resamples is (width != 64)
    assert geometry.apply(np.ascontiguousarray(ramp[..., 0])).shape == (48, width)


def test_pixels_and_a_turn_together() -> None:
    geometry = FrameGeometry.of((64, 48), 1.5, display(0, -1, 1, 0))
    assert geometry.size_wh == (48, 96)
    assert geometry.apply(PICTURE).shape == (96, 48, 3)
    assert "1.5 times as wide" in geometry.note
    assert "turned by 90" in geometry.note


@pytest.mark.parametrize("degrees", [5, -30])
def test_any_angle(degrees: float) -> None:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    geometry = FrameGeometry.of((64, 48), 1, display(c, -s, s, c))
    width, height = (round(64 * abs(c) + 48 * abs(s)), round(64 * abs(s) + 48 * abs(c)))
    assert geometry.size_wh == (width, height)
    dot = np.zeros((48, 64), np.uint8)
    dot[20:25, 50:55] = 255
    y, x = (np.average(axis, weights=geometry.apply(dot)) + 0.5 for axis in np.mgrid[:height, :width])
    # Around the middle, counter-clockwise with y downwards.
    u, v = 52.5 - 32, 22.5 - 24
    assert (x - width / 2, y - height / 2) == pytest.approx((c * u + s * v, -s * u + c * v), abs=0.7)


def test_matrices_that_are_none_are_told() -> None:
    geometry = FrameGeometry.of((64, 48), 1, display(0, 0, 0, 0))
    assert geometry.size_wh == (64, 48)
    assert "ignored" in geometry.note
