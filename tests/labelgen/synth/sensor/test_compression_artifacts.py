"""Block artifacts of old codecs: only where something moves."""

from __future__ import annotations

import cv2
import numpy as np

from labelgen.synth.sensor.compression_artifacts import add_block_artifacts


def test_blocks_change_where_something_moves_and_nowhere_else() -> None:
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
