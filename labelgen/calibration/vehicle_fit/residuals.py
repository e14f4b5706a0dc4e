"""Residuals of the fit: how far bodies reach in the image, and how that changes with their shapes and positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.vehicle_fit.measurements import MeasuredSilhouettes
from labelgen.calibration.vehicle_fit.model_fit import BodyHypotheses, ModelFit
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["FitResiduals", "fit_residuals", "project_support"]

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class FitResiduals:
    """Residuals of R observations in M directions.

    Args:
        miss: (R, M) measured minus predicted reach, in standard deviations.
        slopes: (R, M, 8) derivatives of the prediction, in the same: by place, then by shape.
        weights: (R, M).
        error: (R,) px, the standard deviation.
        outline: (R, M, 3) metres, the body's points that reach farthest.
        costs: (R,) half the robust sum of squares.
    """

    miss: Array
    slopes: Array
    weights: Array
    error: Array
    outline: Array
    costs: Array


def fit_residuals(
    unit: Camera,
    measured: MeasuredSilhouettes,
    hypotheses: BodyHypotheses,
    fit: ModelFit,
    settings: VehicleFitSettings,
) -> FitResiduals:
    """Return how far bodies and silhouettes are apart, with derivatives by place and shape.

    Args:
        unit: camera with the frame's size, scale 1.
        measured: N silhouettes.
        hypotheses: H bodies.
        fit: P pairs of a vehicle and a hypothesis, R observations.
        settings: of the fit.
    """
    assert unit.image_wh is not None
    shape = fit.shape[fit.pair]
    stretch = np.exp(shape[:, :1] + shape[:, 1:4])
    points = hypotheses.points[fit.hypothesis[fit.pair]]
    directions = settings.direction_vectors
    # Single precision is enough to find the farthest points, in half the time.
    pixels = _pixels(unit, *(part.astype(np.float32) for part in (points, stretch, fit.place)))[0]
    farthest = (directions.T.astype(np.float32) @ np.swapaxes(pixels, -1, -2)).argmax(axis=-1)
    outline = np.take_along_axis(points, farthest[..., None], axis=1)
    sizes = measured.sizes[fit.silhouette]
    error = np.hypot(settings.error_width_share * unit.image_wh[0], settings.error_size_share * sizes)
    reach, slopes = _support(unit, outline, stretch, fit.place, directions)
    beyond = settings.reach_beyond * sizes[:, None, None]
    reach += np.einsum("rmi,ri->rm", beyond, shape[:, 4:])
    miss = (measured.support[fit.silhouette] - reach) / error[:, None]
    size, huber = np.abs(miss), settings.huber
    weights = settings.direction_weight * fit.included[:, None] / np.maximum(1, size / huber)
    robust = np.where(size < huber, size**2 / 2, huber * (size - huber / 2)).sum(axis=-1)
    slopes = np.concatenate([slopes, beyond], axis=-1) / error[:, None, None]
    return FitResiduals(miss, slopes, weights, error, outline, np.asarray(settings.direction_weight * robust))


def project_support(unit: Camera, outline: Array, fit: ModelFit, settings: VehicleFitSettings) -> Array:
    """Return how far the bodies reach through another camera, (R, M) px, without shadow and swelling.

    Args:
        unit: the camera, scale 1.
        outline: (R, M, 3) metres, the points that reach farthest, as in `FitResiduals`.
        fit: R observations.
        settings: of the fit.
    """
    shape = fit.shape[fit.pair]
    pixels, _, _ = _pixels(unit, outline, np.exp(shape[:, :1] + shape[:, 1:4]), fit.place)
    return np.asarray(np.einsum("rmi,im->rm", pixels, settings.direction_vectors))


def _pixels(unit: Camera, points: Floats, stretch: Floats, place: Floats) -> tuple[Floats, Floats, Floats]:
    """Project points (R, V, 3) m: px in the image (R, V, 2), in the camera and on the road (R, V, 3) road units.

    All in the precision of the points.
    """
    own = points * stretch[:, None]
    height = np.full((len(place), 1), -unit.height_m, dtype=place.dtype)
    places = own + np.concatenate([place, height], axis=1)[:, None]
    in_camera = places @ unit.axes.astype(points.dtype)
    in_camera[..., 2] = np.maximum(in_camera[..., 2], points.dtype.type(1e-6 * unit.focal))
    pixels = in_camera[..., :2] * (points.dtype.type(unit.focal) / in_camera[..., 2:])
    return pixels + unit.pp.astype(points.dtype), in_camera, own


def _support(unit: Camera, outline: Array, stretch: Array, place: Array, directions: Array) -> tuple[Array, Array]:
    """Return how far points (R, M, 3) reach, each in its direction, (R, M) px, and the derivatives (R, M, 6) of that.

    The derivatives are by place, size and stretch. A small change moves the reach as it moves the farthest point.
    """
    pixels, at, own = _pixels(unit, outline, stretch, place)
    dx, dy = directions
    by_depth = unit.focal / at[..., 2]
    in_camera = np.stack(
        [by_depth * dx, by_depth * dy, -by_depth * (dx * at[..., 0] + dy * at[..., 1]) / at[..., 2]], -1
    )
    on_road = in_camera @ unit.axes.T
    by_size = on_road * own
    reach = np.einsum("rmi,im->rm", pixels, directions)
    return reach, np.concatenate([on_road[..., :2], by_size.sum(axis=-1, keepdims=True), by_size], axis=-1)
