"""Scale from the mean size of vehicles: 3D boxes of silhouettes against the known mean of the traffic.

Every silhouette gets the 3D box whose sides touch it. The medians of the boxes' lengths, widths and heights are
compared with the mean vehicle. Boxes err on the large side, through shadows, mirrors and merged vehicles, so the least
of the three ratios is the scale, as published. The median over silhouettes stands for the typical vehicle: lorries and
pairs of vehicles must not affect it.

Source: Dubska et al., BMVC 2014, section 3.3 (sizes, medians, the least ratio).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.road_units import unit_camera
from labelgen.calibration.scale.estimate import USE_DISTANCE, ScaleEstimate, time_blocks
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, cuboid_sizes, tangent_boxes

__all__ = ["MEAN_VEHICLE_M", "DimensionScaleSettings", "scale_from_dimensions"]

MEAN_VEHICLE_M = (4.27, 1.74, 1.51)
"""Length, width and height of the mean car sold in Europe, as published, metres."""
_NAMES = ("length", "width", "height")


@dataclass(frozen=True)
class DimensionScaleSettings:
    """How the scale is estimated from dimensions."""

    min_silhouettes: int = 8
    """Fewest silhouettes with a 3D box; with fewer the median depends on single vehicles."""
    block_s: float = 5.0
    """Length of the stretches of video that are resampled, seconds; a vehicle should lie in about one."""
    resamples: int = 200
    """Resamples for the spread; more cost time."""


def scale_from_dimensions(
    camera: Camera,
    silhouettes: Sequence[VehicleSilhouette],
    *,
    mean_m: Sequence[float] = MEAN_VEHICLE_M,
    seed: int = 0,
    settings: DimensionScaleSettings | None = None,
) -> ScaleEstimate:
    """Estimate the scale from the sizes of the silhouettes' 3D boxes.

    Args:
        camera: its scale is not used.
        silhouettes: of vehicles that drive along VP1, as many as there are.
        mean_m: (3,) length, width and height of the mean vehicle on this road, metres.
        seed: of the resampling.
        settings: thresholds.

    Raises:
        CalibrationError: too few silhouettes with a box, or the mean vehicle is not three positive numbers.
    """
    settings = settings or DimensionScaleSettings()
    mean = np.asarray(mean_m, dtype=np.float64)
    if mean.shape != (3,) or not (np.isfinite(mean).all() and (mean > 0).all()):
        raise CalibrationError(
            f"mean_m: expected length, width and height in metres, three positive numbers, got {list(mean_m)}"
        )
    unit = unit_camera(camera)
    single = [silhouette for silhouette in silhouettes if not silhouette.joined]
    vertices, valid = tangent_boxes(unit, [silhouette.polygon_px for silhouette in single])
    sizes_lwh = cuboid_sizes(vertices[valid], unit)
    times_s = np.array([silhouette.time_s for silhouette in single])[valid]
    usable = np.isfinite(sizes_lwh).all(axis=1) & (sizes_lwh > 0).all(axis=1)
    sizes, times = sizes_lwh[usable], times_s[usable]
    if len(sizes) < settings.min_silhouettes:
        raise CalibrationError(
            f"auto-dimensions: {len(sizes)} silhouettes have a 3D box, at least {settings.min_silhouettes} are needed; "
            f"{USE_DISTANCE}",
            parameter="scale",
        )
    ratios = mean / np.median(sizes, axis=0)
    rng = np.random.default_rng(seed)
    blocks = time_blocks(times, settings.block_s)
    resampled = []
    for _ in range(settings.resamples):
        rows = np.concatenate([blocks[i] for i in rng.integers(len(blocks), size=len(blocks))])
        resampled.append((mean / np.median(sizes[rows], axis=0)).min())
    return ScaleEstimate(
        float(ratios.min()),
        len(sizes),
        float(np.std(resampled) / ratios.min()),
        "auto-dimensions",
        {f"by_{name}": float(ratio) for name, ratio in zip(_NAMES, ratios, strict=True)},
    )
