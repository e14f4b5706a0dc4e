"""c_c from a vehicle's height, where the camera's is known.

The line that c_c names is the top of the vehicle's front. Its foot, the box's lower side at row y1, is seen at
|y1 - VPU_y| rows from the unused vanishing point, and whatever stands there to the camera's full height h reaches just
there. So a front of height H takes the share H / h of it in a VP2-VP3 picture, H / (h - H) in a VP1-VP2 one, and

    c_c = 1 - k |y1 - VPU_y| / (y1 - y0)

with k that share: exactly, whatever the vehicle's length, width and place. Vehicles are of much the same height; the
cameras they are seen by are not, and a camera's height can hardly be seen in a picture. A detector that has learnt c_c
itself from a few cameras is off by a constant on every other one; one that has learnt log(k h / 1.5 m), the logarithm
of the vehicle's height over 1.5 m, takes h from the calibration.

Source: similar triangles; the use for c_c is ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from labelgen.geometry import Camera
from labelgen.geometry.projective import Array

__all__ = ["VEHICLE_M", "scene_vector", "shares_from_heights"]

VEHICLE_M = 1.5
_CAMERA_M = 8.0
"""Taken for cameras without a scale: most of those above roads hang between 6 and 11 m high."""


def scene_vector(vpu: ArrayLike, camera: Camera) -> Array:
    """(2,) VPU's row in px of the rectified picture, and 1.5 m over the camera's height."""
    height = _CAMERA_M if camera.scale is None else camera.height_m
    return np.array([np.asarray(vpu, dtype=np.float64)[1], VEHICLE_M / height])


def shares_from_heights(heights: Tensor, boxes_xyxy: Tensor, scenes: Tensor) -> Tensor:
    """c_c from what the network says.

    Args:
        heights: (N,) log of the vehicle's height over 1.5 m.
        boxes_xyxy: (N, 4) px.
        scenes: (N, 2) or (2,) of `scene_vector`.

    Returns:
        (N,), not cut to [0, 1].
    """
    row, ratio = scenes.to(boxes_xyxy.dtype).unbind(-1)
    tall = (boxes_xyxy[:, 3] - boxes_xyxy[:, 1]).clamp(min=1.0)
    # An untrained network may say anything; no vehicle is 50 times as high as another.
    return 1 - heights.to(boxes_xyxy.dtype).clamp(-4, 4).exp() * ratio * (boxes_xyxy[:, 3] - row).abs() / tall
