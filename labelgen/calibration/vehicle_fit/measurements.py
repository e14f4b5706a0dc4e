"""Silhouettes as measurements: how far each reaches in evenly spread directions, and where it stands on the road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array

__all__ = ["MeasuredSilhouettes", "measure_silhouettes"]


@dataclass(frozen=True, eq=False)
class MeasuredSilhouettes:
    """N silhouettes of V vehicles.

    Args:
        support: (N, M) px, how far each reaches in M directions.
        sizes: (N,) px, square root of the area.
        feet: (N, 2) road units, middle of the lower side.
        widths: (N,) road units of the lower side.
        times_s: (N,) seconds.
        vehicles: (N,) 0 to V - 1.
    """

    support: Array
    sizes: Array
    feet: Array
    widths: Array
    times_s: Array
    vehicles: NDArray[np.int64]

    def select(self, rows: NDArray[np.bool_]) -> MeasuredSilhouettes:
        """Return some of the silhouettes, rows (N,), with their vehicles numbered anew."""
        parts = {f.name: getattr(self, f.name)[rows] for f in fields(self)}
        return replace(self, **parts | {"vehicles": np.unique(parts["vehicles"], return_inverse=True)[1]})

    def guess_log_size(self, settings: VehicleFitSettings) -> float:
        """Return a guess of the logarithm of road units per metre, too large for vehicles seen from the side."""
        return float(np.median(np.log(self.widths / settings.typical_width_m)))


def measure_silhouettes(
    unit: Camera,
    silhouettes: Sequence[VehicleSilhouette],
    vehicles: NDArray[np.int64],
    settings: VehicleFitSettings,
) -> tuple[MeasuredSilhouettes, NDArray[np.int64]]:
    """Measure the silhouettes that stand on the road, in the order of their vehicles.

    Args:
        unit: camera, scale 1.
        silhouettes: S of them.
        vehicles: (S,) number of each one's vehicle, any numbers.
        settings: of the fit.

    Returns:
        the measurements, and which silhouettes they are of, (N,).
    """
    order = np.argsort(vehicles, kind="stable")
    polygons = [silhouettes[i].polygon_px for i in order.tolist()]
    low = np.array([p.min(axis=0) for p in polygons]).reshape(-1, 2)
    high = np.array([p.max(axis=0) for p in polygons]).reshape(-1, 2)
    left, right = (unit.road_points(np.stack([x, high[:, 1]], axis=1), invalid="nan") for x in (low[:, 0], high[:, 0]))
    widths = np.linalg.norm(right - left, axis=1)
    on_road = np.flatnonzero(np.isfinite(widths) & (widths > 0))
    numbers = order[on_road]
    directions = settings.direction_vectors
    return MeasuredSilhouettes(
        np.array([(polygons[k] @ directions).max(axis=0) for k in on_road.tolist()]).reshape(-1, settings.directions),
        np.array([np.sqrt(cv2.contourArea(polygons[k].astype(np.float32))) for k in on_road.tolist()]),
        ((left + right) / 2)[on_road],
        widths[on_road],
        np.array([silhouettes[i].time_s for i in numbers.tolist()]),
        np.unique(vehicles[numbers], return_inverse=True)[1],
    ), numbers
