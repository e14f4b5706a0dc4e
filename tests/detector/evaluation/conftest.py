"""Recordings shared by the tests of the scores."""

from __future__ import annotations

import pytest
from score_scenes import Traffic, make_scene


@pytest.fixture
def scene() -> Traffic:
    return make_scene()


@pytest.fixture
def traffic(scene: Traffic) -> Traffic:
    """Four cars, all of them tracked without error."""
    for last_s, speed_mps, lane in ((10.0, 20.0, 0), (11.0, 25.0, 1), (12.5, 30.0, 0), (14.0, 22.5, 2)):
        scene.add_both(last_s, speed_mps, lane)
    return scene
