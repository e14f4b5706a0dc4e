"""Scale from the mean size of vehicles: their 3D boxes against what is known of the traffic's mix.

Every silhouette gets the 3D box whose sides touch it; the medians of the boxes' lengths, widths and heights are set
against the mean vehicle. Boxes err on the large side, by shadows, mirrors, and vehicles that merge, so the least of
the three ratios is the scale, as published. The median over silhouettes stands for the typical vehicle: lorries and
pairs of vehicles must not pull it.

Source: Dubska et al., BMVC 2014, section 3.3 (sizes, medians, the least ratio).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labelgen.calibration.observation.silhouettes import Blob
from labelgen.calibration.scale.estimate import ScaleEstimate, time_blocks, unit_camera
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, cuboid_sizes, tangent_boxes
from labelgen.geometry.homography import Array

__all__ = ["MEAN_VEHICLE_M", "scale_from_dimensions", "scale_from_sizes"]

MEAN_VEHICLE_M = (4.27, 1.74, 1.51)
"""Length, width and height of the mean car sold in Europe, as published, metres."""
_FEWEST = 8
_BLOCK_S = 5.0
_RESAMPLES = 200
_NAMES = ("length", "width", "height")


def scale_from_dimensions(
    camera: Camera, blobs: Sequence[Blob], *, mean_m: Sequence[float] = MEAN_VEHICLE_M, seed: int = 0
) -> ScaleEstimate:
    """Scale by the sizes of the silhouettes' 3D boxes.

    Args:
        camera: its scale is not used.
        blobs: silhouettes of vehicles that drive along VP1, as many as there are.
        mean_m: (3,) length, width and height of the mean vehicle on this road, metres.
        seed: of the resampling.

    Raises:
        CalibrationError: too few silhouettes with a box, or a mean vehicle that is none.
    """
    unit = unit_camera(camera)
    blobs = [blob for blob in blobs if not blob.joined]
    vertices, valid = tangent_boxes(unit, [blob.polygon_px for blob in blobs])
    sizes = cuboid_sizes(vertices[valid], unit)
    times = np.array([blob.time_s for blob in blobs])[valid]
    return scale_from_sizes(sizes, times, mean_m=mean_m, seed=seed)


def scale_from_sizes(
    sizes_lwh: Array, times_s: Array, *, mean_m: Sequence[float] = MEAN_VEHICLE_M, seed: int = 0
) -> ScaleEstimate:
    """Scale from the sizes of boxes, as above.

    Args:
        sizes_lwh: (N, 3) in units of the camera without scale; rows with NaN do not count.
        times_s: (N,) seconds.
        mean_m: (3,) metres.
        seed: of the resampling.
    """
    mean = np.asarray(mean_m, dtype=np.float64)
    if mean.shape != (3,) or not (np.isfinite(mean).all() and (mean > 0).all()):
        raise CalibrationError(
            f"mean vehicle: expected length, width and height in metres, three positive numbers, got {list(mean_m)}"
        )
    usable = np.isfinite(sizes_lwh).all(axis=1) & (sizes_lwh > 0).all(axis=1)
    sizes, times = sizes_lwh[usable], np.asarray(times_s)[usable]
    if len(sizes) < _FEWEST:
        raise CalibrationError(
            f"scale: {len(sizes)} silhouettes have a 3D box, at least {_FEWEST} are needed; use more of the video, "
            "or a known distance (--scale distance:x1,y1,x2,y2,METRES)"
        )
    ratios = mean / np.median(sizes, axis=0)
    rng = np.random.default_rng(seed)
    blocks = time_blocks(times, _BLOCK_S)
    resampled = []
    for _ in range(_RESAMPLES):
        rows = np.concatenate([blocks[i] for i in rng.integers(len(blocks), size=len(blocks))])
        resampled.append((mean / np.median(sizes[rows], axis=0)).min())
    return ScaleEstimate(
        float(ratios.min()),
        len(sizes),
        float(np.std(resampled) / ratios.min()),
        "auto-dimensions",
        {f"by_{name}": float(ratio) for name, ratio in zip(_NAMES, ratios, strict=True)},
    )
