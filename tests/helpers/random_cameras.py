"""Random cameras above a road, made from rotations rather than from vanishing points."""

from __future__ import annotations

import numpy as np

from labelgen.geometry import Camera

FRAME_WH = (1920, 1080)


def random_camera(
    rng: np.random.Generator, *, pitch_deg: tuple[float, float] = (6.0, 35.0), roll_deg: float = 8.0
) -> Camera:
    """A camera that looks along the road within 40 degrees to either side of it."""
    focal = rng.uniform(1000, 5000)
    pp = np.array(FRAME_WH) / 2 + rng.uniform(-40, 40, 2)
    pitch, yaw, roll = np.radians(
        [rng.uniform(*pitch_deg), rng.uniform(0.5, 40) * rng.choice([-1, 1]), rng.uniform(-roll_deg, roll_deg)]
    )
    tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])

    def vanishing_point(azimuth: float) -> np.ndarray:
        x, y, z = turn @ tilt @ np.array([np.sin(azimuth), 0, np.cos(azimuth)])
        return pp + focal * np.array([x, y]) / z

    return Camera(
        vanishing_point(yaw), vanishing_point(yaw + np.pi / 2), pp, rng.uniform(0.005, 0.05), image_wh=FRAME_WH
    )
