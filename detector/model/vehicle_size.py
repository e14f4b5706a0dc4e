"""c_c from a vehicle's height and length, where the camera is calibrated.

How much of a vehicle's 2D box is front and how much is roof depends on the camera as much as on the vehicle: a camera
that is mounted higher, or has a longer lens, sees a longer roof on the same car, and a picture of the car alone does
not show which. A network that has learnt c_c from a few cameras has a constant error on every other one. The vehicle's
height H and length L are the same for every camera, and the calibration gives the rest. Let y1 be the box's lower side
and F = |y1 - VPU_y| the rows from there to the unused vanishing point. A camera at height h sees the vehicle's front at
a distance D with

    in VP2-VP3:  h / D = F / s      k = H / h            m = (L / D) (1 - k) / (1 + L / D)
    in VP1-VP2:  h / D = s / F      k = H / (h - H)      m = (L / D) (1 + k)

where s is a constant of the rectified picture. Then the front is k F rows high, the roof m F rows, and
c_c = m / (k + m). Only ratios of lengths are used, so an error of the calibration's scale nearly cancels: an error of
10 % changes c_c by less than 0.02.

Source: similar triangles; the published method has no such output.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from labelgen.geometry import Camera, Pair
from labelgen.geometry.boxes import CUT_MARGIN_PX
from labelgen.geometry.homography import Array, apply_homography

__all__ = ["TYPICAL_HEIGHT_M", "TYPICAL_LENGTH_M", "merge_sizes", "scene_vector", "sizes_from_cc", "transform_scene"]

TYPICAL_HEIGHT_M, TYPICAL_LENGTH_M = 1.5, 4.5
"""Height and length of a car, m, for which the network's outputs are 0; part of what a checkpoint's weights mean."""
_LENGTHS_M = (0.5, 40.0)
"""Range of lengths, m, that a network is trained to predict; a label beyond it is clamped."""
_TOP_WEIGHT = 0.5
"""Share of the upper side that follows from the sizes in a merged box; the rest is the predicted upper side."""
_REFERENCE_DISTANCE = 4.0
"""Where on the road s is measured, in heights of the camera; every distance gives the same s."""


def scene_vector(matrix: ArrayLike, vpu: ArrayLike, pair: Pair, camera: Camera) -> Array:
    """Return the four numbers of camera and rectification that turn sizes into c_c.

    Args:
        matrix: (3, 3) frame px -> rectified px.
        vpu: (2,) unused vanishing point, rectified px.
        pair: of the rectification.
        camera: of the frame.

    Returns:
        (4,): row of VPU in px; 1 over the camera's height in 1/m, 0 where the camera has no scale; s in px; the power
        of D that the rows are proportional to: -1 for VP2-VP3, 1 for VP1-VP2.
    """
    row, power = float(np.asarray(vpu, dtype=np.float64)[1]), -1.0 if pair is Pair.VP2_VP3 else 1.0
    if camera.scale is None:
        return np.array([row, 0.0, 0.0, power])
    road_point = camera.project([[_REFERENCE_DISTANCE * camera.height_m, 0.0]])
    rows = abs(float(apply_homography(np.asarray(matrix), road_point, behind="keep")[0, 1]) - row)
    return np.array([row, 1 / camera.height_m, rows * _REFERENCE_DISTANCE**-power, power])


def transform_scene(scene: ArrayLike, scale_y: float, shift_y: float) -> Array:
    """Return the scene vector (4,) of a picture whose rows y are mapped to scale_y * y + shift_y, in px."""
    row, ratio, s, power = np.asarray(scene, dtype=np.float64)
    return np.array([scale_y * row + shift_y, ratio, abs(scale_y) * s, power])


def sizes_from_cc(cc: Tensor, boxes_xyxy: Tensor, scene: Tensor) -> Tensor:
    """Compute the sizes that a network should predict for labels; the inverse of `merge_sizes` with weight 1.

    Args:
        cc: (N,) in [0, 1].
        boxes_xyxy: (N, 4) px.
        scene: (4,) of `scene_vector`, of a camera of known height.

    Returns:
        (N, 2) log(k h / 1.5 m), nearly the logarithm of the height over 1.5 m, and log(L / 4.5 m). The front is taken
        as at least 1 px high, the length as 0.5 to 40 m.
    """
    rows, nearness = _from_camera(boxes_xyxy, scene)
    heights = boxes_xyxy[:, 3] - boxes_xyxy[:, 1]
    k, m = ((1 - cc) * heights).clamp(min=1.0) / rows, cc * heights / rows
    # L / D.
    reach = m / (1 - k - m).clamp(min=1e-6) if scene[3] < 0 else m / (1 + k)
    length = (reach / (nearness * scene[1])).clamp(*_LENGTHS_M)
    return torch.stack([torch.log(k / (scene[1] * TYPICAL_HEIGHT_M)), torch.log(length / TYPICAL_LENGTH_M)], dim=1)


def merge_sizes(
    cc: Tensor, boxes_xyxy: Tensor, sizes: Tensor, scene: Tensor, *, weight: float, height_px: float
) -> tuple[Tensor, Tensor]:
    """Combine the c_c and boxes that a network predicts with those that follow from its predicted sizes.

    The box's upper side becomes the mean of both. A box stays unchanged where the camera's height is not known, and
    where the picture's lower border cuts it: it then does not end on the road.

    Args:
        cc: (N,) predicted.
        boxes_xyxy: (N, 4) px, predicted.
        sizes: (N, 2) predicted, as of `sizes_from_cc`.
        scene: (4,) of `scene_vector`.
        weight: of the c_c that follows from the sizes, 0 to 1.
        height_px: height of the picture.

    Returns:
        c_c (N,) in [0, 1], boxes (N, 4) px.
    """
    if scene[1] == 0:
        return cc.clamp(0, 1), boxes_xyxy
    rows, nearness = _from_camera(boxes_xyxy, scene)
    k = sizes[:, 0].exp() * TYPICAL_HEIGHT_M * scene[1]
    reach = sizes[:, 1].exp() * TYPICAL_LENGTH_M * scene[1] * nearness
    m = reach * (1 - k).clamp(min=0) / (1 + reach) if scene[3] < 0 else reach * (1 + k)
    bottoms = boxes_xyxy[:, 3]
    whole = bottoms < height_px - CUT_MARGIN_PX
    tops = ((1 - _TOP_WEIGHT) * boxes_xyxy[:, 1] + _TOP_WEIGHT * (bottoms - rows * (k + m))).clamp(min=0)
    merged = boxes_xyxy.clone()
    merged[:, 1] = torch.where(whole, tops, boxes_xyxy[:, 1])
    return torch.where(whole, (1 - weight) * cc + weight * m / (k + m), cc).clamp(0, 1), merged


def _from_camera(boxes_xyxy: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
    """Return F (N,), at least 1 px, and h / D (N,) of the boxes' lower sides."""
    rows = (boxes_xyxy[:, 3] - scene[0]).abs().clamp(min=1.0)
    return rows, (rows / scene[2]) ** -scene[3]
