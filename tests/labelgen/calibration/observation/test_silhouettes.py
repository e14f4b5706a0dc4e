"""Silhouettes of masks, and the sample of them that a pass over a video keeps."""

from __future__ import annotations

import cv2
import numpy as np

from labelgen.calibration.observation.silhouettes import (
    SilhouetteCollector,
    SilhouetteSettings,
    silhouettes_from_masks,
)
from labelgen.masks import InstanceMasks


def test_masks_at_the_border_are_left_out_and_stacked_ones_joined() -> None:
    masks = []
    for x0, y0, x1, y1 in [(0, 50, 40, 80), (100, 50, 150, 80), (102, 90, 148, 110), (300, 90, 340, 110)]:
        mask = np.zeros((180, 400), dtype=np.bool_)
        mask[y0:y1, x0:x1] = True
        masks.append(mask)
    silhouettes = silhouettes_from_masks(InstanceMasks.from_masks((400, 180), masks, [0] * 4, np.ones(4)), 7, 0.28, 3.0)
    boxes = [[*b.polygon_px.min(axis=0), *b.polygon_px.max(axis=0)] for b in silhouettes]
    expected = [[300, 150, 450, 240], [306, 270, 444, 330], [900, 270, 1020, 330], [300, 150, 450, 330]]
    np.testing.assert_allclose(boxes, expected, atol=1)
    assert [b.joined for b in silhouettes] == [False, False, False, True]
    assert {(b.frame_number, b.time_s) for b in silhouettes} == {(7, 0.28)}


def test_the_collector_keeps_a_bounded_sample() -> None:
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(90, 130, (45, 80, 3), dtype=np.uint8), (960, 540))
    collector = SilhouetteCollector(SilhouetteSettings(capacity=20))
    for number in range(40):
        picture = ground.copy()
        x = 40 + 20 * number
        picture[200:320, x : x + 100] = (200, 40, 30)
        collector.update(number, 0.4 * number, picture)
        collector.update(number, 0.4 * number + 0.04, picture)  # too soon after the last to look at
    silhouettes = collector.silhouettes()
    assert 25 <= collector.count <= 40
    assert len(silhouettes) == 20
    middles = np.array([b.polygon_px.mean(axis=0) for b in silhouettes])
    np.testing.assert_allclose(middles[:, 0], [90 + 20 * b.frame_number for b in silhouettes], atol=8)
    np.testing.assert_allclose(middles[:, 1], 260, atol=8)
