"""Places where traffic is filmed: camera, lanes, measurement lines, road mask and a picture of the empty road.

Convention: the road frame of `Camera`, metres: x along the road, y left, z up, the camera above the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.geometry import Camera
from labelgen.geometry.camera import look_at_road

__all__ = ["Lane", "RoadScene", "carriageways", "line_through", "procedural_scene", "road_to_image", "visible_range"]

LANE_WIDTH = 3.6
"""Width of a made-up lane, metres."""
FARTHEST_M = 140.0
"""X beyond which the road is not looked at, metres: vehicles are a few pixels there."""
_MIN_VISIBLE_LENGTH_M = 32.0
"""Length of the measured road that a made-up camera must see, metres: less has no room for measurement lines."""
_TRAFFIC_TO_M = 170.0
"""X up to which made-up traffic drives, metres: beyond `FARTHEST_M`, so that no vehicle appears within the picture."""


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane, straight in the road frame: its middle runs through (x, y) = (0, y0) with slope dy/dx.

    Args:
        y0: y of the middle at x = 0, metres.
        slope: dy/dx; nearly 0.
        heading: +1 away from the camera, -1 towards it.
        speed_kmh: usual speed.
        index: number in `gt_data.pkl`, None for lanes that are not measured.
    """

    y0: float
    slope: float
    heading: int
    speed_kmh: float
    index: int | None

    def y(self, x: Any) -> Any:
        """Return y of the middle of the lane at x, metres."""
        return self.y0 + self.slope * np.asarray(x)


@dataclass(frozen=True, eq=False)
class RoadScene:
    """A place where traffic is filmed.

    Args:
        name: session name.
        camera: with scale and image size.
        lanes: where vehicles drive.
        lane_lines: homogeneous px lines between the measured lanes, one more than those.
        measurement_lines: homogeneous px lines across the road; the line that is crossed last comes first.
        road_mask: (H, W) bool, the measured road.
        background: (H, W, 3) uint8 BGR, the empty road; None until it is drawn.
        x_range: metres, nearest and farthest X at which vehicles are shown.
    """

    name: str
    camera: Camera
    lanes: tuple[Lane, ...]
    lane_lines: tuple[NDArray[np.float64], ...]
    measurement_lines: tuple[NDArray[np.float64], ...]
    road_mask: NDArray[np.bool_]
    background: NDArray[np.uint8] | None
    x_range: tuple[float, float]


def visible_range(camera: Camera, y: float, far_m: float = FARTHEST_M) -> tuple[float, float] | None:
    """Return the nearest and farthest X, metres, at which the road at this Y is in the frame; None where none is."""
    assert camera.image_wh is not None
    x = np.arange(-30.0, far_m, 0.5)
    pixels = camera.project(np.stack([x, np.full_like(x, y)], axis=1))
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0).all(axis=1) & (pixels <= camera.image_wh).all(axis=1)
    if not inside.any():
        return None
    indices = np.flatnonzero(inside)
    return float(x[indices[0]]), float(x[indices[-1]])


def road_to_image(camera: Camera) -> NDArray[np.float64]:
    """Return the (3, 3) homography from the road, metres, to the image, px.

    The third coordinate is positive in front of the camera.
    """
    rotation = camera.axes.T
    intrinsic = np.array([[camera.focal, 0, camera.pp[0]], [0, camera.focal, camera.pp[1]], [0, 0, 1.0]])
    origin = -rotation @ np.array([0.0, 0.0, camera.height_m])
    out: NDArray[np.float64] = intrinsic @ np.stack([rotation[:, 0], rotation[:, 1], origin], axis=1)
    return out


def carriageways(scene: RoadScene) -> list[tuple[float, float, list[float]]]:
    """Return per carriageway of a made-up scene its two borders and the borders between its lanes: y, metres."""
    groups = []
    for measured in (True, False):
        middles = sorted(lane.y0 for lane in scene.lanes if (lane.index is not None) == measured)
        if middles:
            inner = [(a + b) / 2 for a, b in pairwise(middles)]
            groups.append((middles[0] - LANE_WIDTH / 2, middles[-1] + LANE_WIDTH / 2, inner))
    return groups


def line_through(camera: Camera, a: tuple[float, float], b: tuple[float, float]) -> NDArray[np.float64]:
    """Return the homogeneous px line through two road points (x, y), metres; its normal has unit length."""
    p, q = camera.project(np.array([a, b]))
    line = np.cross([*p, 1.0], [*q, 1.0])
    out: NDArray[np.float64] = line / np.hypot(line[0], line[1])
    return out


def procedural_scene(
    rng: np.random.Generator, size_wh: tuple[int, int], *, heading: int | None = None, name: str = "synthetic",
    both_ways: bool = False, depth_m: float = 60.0, seen_from: tuple[Camera, float] | None = None,
) -> RoadScene:  # fmt: skip
    """Make up a road with one to four lanes, most with a second carriageway, without a picture.

    Args:
        rng: decides everything.
        size_wh: frame size, px.
        heading: of the measured carriageway; at random when None.
        name: of the session and its camera.
        both_ways: always have a second carriageway; otherwise most scenes do.
        depth_m: greatest length of the measured road.
        seen_from: the camera, and y of the middle of the measured carriageway, metres; made up when None.
    """
    lanes_here = int(rng.choice([1, 2, 3, 4], p=[0.08, 0.37, 0.4, 0.15]))
    heading = int(rng.choice([-1, 1], p=[0.6, 0.4])) if heading is None else heading
    camera, middle = seen_from or _made_up_camera(rng, size_wh, name)
    while seen_from is None and _visible_length(camera, middle) < _MIN_VISIBLE_LENGTH_M:
        camera, middle = _made_up_camera(rng, size_wh, name)
    distance = float(camera.road_points(camera.pp)[0])

    # Right-hand traffic: traffic that comes towards the camera drives on its left.
    edges = middle + LANE_WIDTH * (np.arange(lanes_here + 1) - lanes_here / 2)
    lanes = []
    for k in range(lanes_here):
        fast = k if heading < 0 else lanes_here - 1 - k
        speed = 78 + 14 * (lanes_here - 1 - fast if heading < 0 else fast)
        lanes.append(Lane((edges[k] + edges[k + 1]) / 2, 0.0, heading, float(speed), k))
    if rng.random() < 0.7 or both_ways:
        gap = rng.uniform(0.3, 3.0) if rng.random() < 0.6 else rng.uniform(2.5, 7.0)
        side = -1 if heading < 0 else 1
        start = (edges[0] if side < 0 else edges[-1]) + side * gap
        lanes += [
            Lane(start + side * LANE_WIDTH * (k + 0.5), 0.0, -heading, 80.0 + 12 * (1 - k), None)
            for k in range(max(1, lanes_here - int(rng.integers(0, 2))))
        ]
    near, far = visible_range(camera, middle, max(FARTHEST_M, depth_m)) or (distance - 5, distance + 30)
    near = max(near, 2.0) + 3.0
    far = min(far - 3.0, near + depth_m)
    marks = np.linspace(near + 2, far - 2, 3)
    across = [line_through(camera, (x, edges[0]), (x, edges[-1])) for x in (marks if heading < 0 else marks[::-1])]
    along = [line_through(camera, (near, y), (far, y)) for y in edges]
    mask = _carriageway_mask(camera, edges[0] - 0.5, edges[-1] + 0.5, near - 2.5, far + 15)
    return RoadScene(name, camera, tuple(lanes), tuple(along), tuple(across), mask, None, (-25.0, _TRAFFIC_TO_M))


def _visible_length(camera: Camera, y: float) -> float:
    """Return how many metres of the road at y lie in the picture."""
    near, far = visible_range(camera, y) or (0.0, 0.0)
    return far - near


def _made_up_camera(rng: np.random.Generator, size_wh: tuple[int, int], name: str) -> tuple[Camera, float]:
    """Make up a camera on a bridge, on a mast or beside the road; returns it and y of the measured carriageway."""
    low, high, steepest, aside = ((5.5, 11.5, 24, 7.0), (3.8, 8.0, 20, 12.0), (8.0, 17.0, 36, 14.0))[
        int(rng.choice(3, p=[0.6, 0.2, 0.2]))
    ]
    height = rng.uniform(low, high)
    middle = rng.uniform(-aside, aside)
    distance = height / np.tan(np.radians(rng.uniform(12, steepest)))
    focal = size_wh[0] * np.exp(rng.uniform(np.log(0.9), np.log(2.0)))
    target = (distance, middle * rng.uniform(0.6, 0.95))
    return look_at_road(height, target, focal, size_wh, rng.normal(0, 1.0), name), middle


def _carriageway_mask(camera: Camera, y0: float, y1: float, x0: float, x1: float) -> NDArray[np.bool_]:
    assert camera.image_wh is not None
    x = np.linspace(x0, x1, 60)
    border = np.concatenate([np.stack([x, np.full_like(x, y0)], 1), np.stack([x, np.full_like(x, y1)], 1)[::-1]])
    pixels = camera.project(border)
    mask = np.zeros(camera.image_wh[::-1], dtype=np.uint8)
    cv2.fillPoly(mask, [np.round(pixels[np.isfinite(pixels).all(axis=1)]).astype(np.int32)], 1)
    return mask.astype(np.bool_)
