"""Draw a calibration: the road plane's grid, the vanishing directions, and the tracks it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.klt_tracks import Track
from labelgen.drawing import BLUE, CYAN, GREEN, RED, WHITE, YELLOW, Picture, draw_polyline, draw_text
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["draw_calibration"]

_MIN_WIDTH_PX = 1280
_MAX_TRACKS = 120
"""Tracks drawn at most: more hide the picture."""
_ROUND_STEPS = (1, 2, 5, 10, 20, 50)
"""Distances between grid lines, times a power of 10."""
_POINTS_PER_LINE = 60


def draw_calibration(
    image: NDArray[np.uint8], camera: Camera, tracks: Sequence[Track] = (), lines: Sequence[str] = ()
) -> Picture:
    """Draw a calibration over an image of the scene.

    Args:
        image: (H, W, 3) uint8 BGR, a frame or the background image.
        camera: the calibration; without a scale the grid is in heights of the camera instead of metres.
        tracks: those that VP1 rests on; about 120 are drawn.
        lines: text for the upper left corner.

    Returns:
        (h, w, 3) uint8 BGR, at least 1280 px wide.
    """
    zoom = max(1.0, _MIN_WIDTH_PX / image.shape[1])
    enlarged = np.asarray(cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC))
    picture = np.asarray(enlarged * 0.8, dtype=np.uint8)
    unit = "m"
    if camera.scale is None:
        unit = "camera heights"
        camera = replace(camera, scale=1.0)
        camera = replace(camera, scale=1 / camera.height_m)
    zoomed = camera.resized(zoom)
    drawn_tracks = list(tracks)[:: max(1, len(tracks) // _MAX_TRACKS)]
    for track in drawn_tracks:
        draw_polyline(picture, track.points_px * zoom, YELLOW, 1)
    step = _draw_grid(picture, zoomed, drawn_tracks, zoom)
    _draw_horizon(picture, zoomed)
    _draw_directions(picture, zoomed, drawn_tracks, zoom)
    text = [*lines, f"grid: {step[0]:g} {unit} along, {step[1]:g} across; red VP1, green VP2, blue VP3"]
    for row, line in enumerate(text):
        draw_text(picture, line, (12, 26 + 24 * row), 0.55)
    return picture


def _region(picture: Picture, camera: Camera, tracks: Sequence[Track], zoom: float) -> tuple[Array, Array]:
    """Return the ranges (2,) of X and Y, metres, of the road under the tracks; in the whole picture without tracks."""
    height, width = picture.shape[:2]
    if tracks:
        points = np.concatenate([track.points_px for track in tracks]) * zoom
    else:
        points = np.stack(np.meshgrid(np.linspace(0, width, 15), np.linspace(0, height, 15)), axis=-1).reshape(-1, 2)
    road = camera.road_points(points, invalid="nan")
    road = road[np.isfinite(road).all(axis=1)]
    if not len(road):
        return np.array([0.0, 1.0]), np.array([-1.0, 1.0])
    # Features lie above the road, which makes what is far away seem farther; the nearer part is safe.
    x = np.quantile(road[:, 0], [0.01, 0.9])
    return np.array([min(x[0], 0.5 * x[1]), x[1]]), np.quantile(road[:, 1], [0.02, 0.98])


def _draw_grid(picture: Picture, camera: Camera, tracks: Sequence[Track], zoom: float) -> tuple[float, float]:
    """Draw the grid; return its steps along and across the road, metres."""
    x, y = _region(picture, camera, tracks, zoom)
    steps = _step(x[1] - x[0], 12), _step(y[1] - y[0], 8)
    at_x, at_y = (np.arange(np.floor(r[0] / s), np.ceil(r[1] / s) + 1) * s for r, s in zip((x, y), steps, strict=True))
    for value in at_y:
        along = np.linspace(at_x[0], at_x[-1], _POINTS_PER_LINE)
        _draw_on_road(picture, camera, np.stack([along, np.full_like(along, value)], axis=1))
    for value in at_x:
        across = np.linspace(at_y[0], at_y[-1], _POINTS_PER_LINE)
        _draw_on_road(picture, camera, np.stack([np.full_like(across, value), across], axis=1))
    return steps


def _draw_on_road(picture: Picture, camera: Camera, points_m: Array) -> None:
    """Draw a line through points (N, 2) m of the road plane."""
    px = camera.project(points_m)
    px = px[np.isfinite(px).all(axis=1)]
    if len(px) > 1:
        draw_polyline(picture, px, CYAN, 1)


def _step(extent: float, lines: int) -> float:
    """Return a round step that divides an extent into about so many parts."""
    rough = max(extent, 1e-9) / lines
    power = 10.0 ** np.floor(np.log10(rough) - 1)
    return float(min((s * power * k for k in (1, 10) for s in _ROUND_STEPS), key=lambda s: abs(np.log(s / rough))))


def _draw_horizon(picture: Picture, camera: Camera) -> None:
    """Draw the line through VP1 and VP2."""
    direction = camera.vp2 - camera.vp1
    direction /= np.linalg.norm(direction)
    reach = 2.0 * picture.shape[1] + float(np.linalg.norm(camera.vp1))
    draw_polyline(picture, [camera.vp1 - direction * reach, camera.vp1 + direction * reach], WHITE, 1)


def _draw_directions(picture: Picture, camera: Camera, tracks: Sequence[Track], zoom: float) -> None:
    """Draw arrows to the three vanishing points from a few places on the road."""
    height, width = picture.shape[:2]
    points = np.concatenate([t.points_px for t in tracks]) * zoom if tracks else np.array([[width / 2, height * 0.7]])
    low, high = np.quantile(points, [0.15, 0.85], axis=0)
    places = [(low + high) / 2, [low[0], high[1]], [high[0], high[1]], [low[0], low[1]], [high[0], low[1]]]
    length = 0.05 * width
    for place in np.array(places):
        for vp, colour, sign in ((camera.vp1, RED, 1), (camera.vp2, GREEN, 1), (camera.vp3, BLUE, -1)):
            direction = (vp - place) * sign
            tip = place + direction / np.linalg.norm(direction) * length
            start, end = ((round(float(p[0])), round(float(p[1]))) for p in (place, tip))
            cv2.arrowedLine(picture, start, end, colour, 2, cv2.LINE_AA, tipLength=0.25)
