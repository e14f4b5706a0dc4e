"""Pictures of made-up roads of which only some windows are needed."""

from __future__ import annotations

import numpy as np
import pytest

from labelgen.synth.scene.road_image import draw_scene
from labelgen.synth.scene.scene import procedural_scene
from labelgen.synth.scene.strips import strips
from labelgen.synth.shading.lighting import Weather, make_light

pytestmark = pytest.mark.slow

SIZE = (320, 180)
WINDOWS = np.array([[20, 60, 90, 130], [70, 100, 200, 170], [300, 0, 320, 10]])


def covered(windows: np.ndarray | None) -> np.ndarray:
    count = np.zeros(SIZE[::-1], dtype=int)
    for rows, columns in strips(SIZE, 48, windows):
        count[rows, columns] += 1
    return count


def test_strips_cover_every_window_once() -> None:
    count = covered(WINDOWS)
    assert count.max() == 1
    for x0, y0, x1, y1 in WINDOWS.tolist():
        assert (count[y0:y1, x0:x1] == 1).all()
    assert count.mean() < 0.7
    assert (covered(None) == 1).all()


def test_windows_show_what_the_whole_picture_shows() -> None:
    pictures, covers = [], []
    for windows in (None, WINDOWS):
        scene = procedural_scene(np.random.default_rng(5), SIZE, both_ways=True)
        light = make_light(Weather.DAY, np.random.default_rng(6))
        picture, static_layer = draw_scene(scene, light, np.random.default_rng(7), windows)
        assert static_layer is not None
        pictures.append(picture.astype(int))
        covers.append(static_layer.cover)
    for x0, y0, x1, y1 in WINDOWS.tolist():
        part = np.s_[y0:y1, x0:x1]
        assert (covers[0][part] == covers[1][part]).all()
        # The wear on the lanes is sampled per strip, so that it may differ a little.
        assert np.abs(pictures[0][part] - pictures[1][part]).mean() < 1
