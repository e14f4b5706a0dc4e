"""c_c from a vehicle's height, where the camera's is known.

The line that c_c names is the top of the vehicle's front. Its foot, the box's lower side at row y1, is seen at
|y1 - VPU_y| rows from the unused vanishing point, and whatever stands there to the camera's full height h reaches just
there. So a front of height H takes the share H / h of it in a VP2-VP3 picture, H / (h - H) in a VP1-VP2 one, and

    c_c = 1 - k |y1 - VPU_y| / (y1 - y0)

with k that share: exactly, whatever the vehicle's length, width and place. Vehicles are of much the same height; the
cameras that see them are not, and a camera's height can hardly be seen in a picture. So a network that has learnt c_c
from a few cameras is off by a constant on every other one. What it says of log(k h / 1.5 m), nearly the logarithm of
the vehicle's height over 1.5 m, holds for any camera, but goes through the height of its 2D box. The errors of the two
have nothing to do with each other: their mean is better than either.

Source: similar triangles; the use for c_c is ours.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from labelgen.geometry import Camera
from labelgen.geometry.projective import Array

__all__ = ["VEHICLE_M", "heights_from_cc", "merge_cc", "scene_vector"]

VEHICLE_M = 1.5


def scene_vector(vpu: ArrayLike, camera: Camera) -> Array:
    """(2,) VPU's row in px of the rectified picture, and 1.5 m over the camera's height, 0 where it is not known."""
    ratio = 0.0 if camera.scale is None else VEHICLE_M / camera.height_m
    return np.array([np.asarray(vpu, dtype=np.float64)[1], ratio])


def heights_from_cc(cc: Tensor, boxes_xyxy: Tensor, scene: Tensor) -> Tensor:
    """log(k h / 1.5 m) of labels.

    Args:
        cc: (N,).
        boxes_xyxy: (N, 4) px.
        scene: (2,) of `scene_vector`, of a camera of known height.

    Returns:
        (N,), for a front of at least 1 px.
    """
    front = ((1 - cc) * (boxes_xyxy[:, 3] - boxes_xyxy[:, 1])).clamp(min=1.0)
    return torch.log(front / _common_front(boxes_xyxy, scene))


def merge_cc(cc: Tensor, heights: Tensor, boxes_xyxy: Tensor, scene: Tensor, weight: float) -> Tensor:
    """c_c from both of a network's estimates.

    Args:
        cc: (N,) as seen.
        heights: (N,) log(k h / 1.5 m).
        boxes_xyxy: (N, 4) px.
        scene: (2,) of `scene_vector`.
        weight: of the c_c that follows from the height, 0 to 1; 0 is what a camera of unknown height gets.

    Returns:
        (N,) in [0, 1].
    """
    if scene[1] == 0:
        return cc.clamp(0, 1)
    tall = (boxes_xyxy[:, 3] - boxes_xyxy[:, 1]).clamp(min=1.0)
    # Where the box is a poor one, its c_c must not lie outside of it.
    told = (1 - heights.exp() * _common_front(boxes_xyxy, scene) / tall).clamp(0, 1)
    return ((1 - weight) * cc + weight * told).clamp(0, 1)


def _common_front(boxes_xyxy: Tensor, scene: Tensor) -> Tensor:
    """(N,) px, the height in the picture of something 1.5 m high that stands on the box's lower side."""
    return scene[1] * (boxes_xyxy[:, 3] - scene[0]).abs().clamp(min=1.0)
