"""A plain camera, its road, and the rectification of both pairs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from labelgen.geometry import Camera, Pair, Rectification


@pytest.fixture
def camera() -> Camera:
    """A plain camera at 640x360, some 9 m above the road, no roll."""
    return Camera([269.2, -43.6], [12914.9, -43.6], [320, 180], 0.05, image_wh=(640, 360), name="plain")


@pytest.fixture
def road(camera: Camera) -> np.ndarray:
    """(360, 640) uint8, a strip of road that ends below the horizon."""
    mask = np.zeros((360, 640), np.uint8)
    cv2.fillPoly(mask, [np.array([[60, 350], [600, 350], [360, 90], [230, 90]])], 255)
    return mask


@pytest.fixture(params=list(Pair), ids=str)
def rectification(request: pytest.FixtureRequest, camera: Camera, road: np.ndarray) -> Rectification:
    """The plain camera's road, rectified by either pair."""
    size = (320, 180) if request.param is Pair.VP2_VP3 else (180, 320)
    return Rectification.from_road_mask(camera, road, request.param, size)
