"""c_c from a vehicle's height and length, where the camera is calibrated.

How much of a vehicle's 2D box is front and how much is roof depends on the camera as much as on the vehicle: the same
car is seen with a longer roof from higher up, or through a longer lens, and neither can be told from a picture of the
car alone. A network that has learnt c_c from a few cameras is off by a constant on every other one. The vehicle's own
height H and length L are the same for every camera, and the calibration says the rest. With the box's lower side y1,
and F = |y1 - VPU_y| the rows from there to the unused vanishing point, a camera of height h sees the vehicle's front at
a distance D with

    in VP2-VP3:  h / D = F / s      k = H / h            m = (L / D) (1 - k) / (1 + L / D)
    in VP1-VP2:  h / D = s / F      k = H / (h - H)      m = (L / D) (1 + k)

where s belongs to the picture. Then the front is k F rows high and the roof m F, exactly, and c_c = m / (k + m). Only
ratios of lengths go into it, so an error of the calibration's scale nearly cancels: one of 10 % moves c_c by less than
0.02.

Source: similar triangles; the use for c_c is ours.
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


_TOP_WEIGHT = 0.5
_AHEAD = 4.0
"""Where the road's scale is read off, in heights of the camera; any place gives the same."""
_LENGTHS_M = (0.5, 40.0)


def scene_vector(matrix: ArrayLike, vpu: ArrayLike, pair: Pair, camera: Camera) -> Array:
    """What turns sizes into c_c in a rectified picture.

    Args:
        matrix: (3, 3) frame px -> rectified px.
        vpu: (2,) rectified px.
        pair: of the rectification.
        camera: of the frame.

    Returns:
        (4,) row of VPU, px; 1 over the camera's height, 1/m, 0 where it is not known; s, px; -1 for VP2-VP3, where rows
        go with 1 / D, or 1 for VP1-VP2, where they go with D.
    """
    row, power = float(np.asarray(vpu, dtype=np.float64)[1]), -1.0 if pair is Pair.VP2_VP3 else 1.0
    if camera.scale is None:
        return np.array([row, 0.0, 0.0, power])
    foot = camera.project([[_AHEAD * camera.height_m, 0.0]])
    rows = abs(float(apply_homography(np.asarray(matrix), foot, behind="keep")[0, 1]) - row)
    return np.array([row, 1 / camera.height_m, rows * _AHEAD**-power, power])


def transform_scene(scene: ArrayLike, scale_y: float, shift_y: float) -> Array:
    """The scene (4,) of a picture whose rows y have become scale_y * y + shift_y."""
    row, ratio, s, power = np.asarray(scene, dtype=np.float64)
    return np.array([scale_y * row + shift_y, ratio, abs(scale_y) * s, power])


def sizes_from_cc(cc: Tensor, boxes_xyxy: Tensor, scene: Tensor) -> Tensor:
    """What a network should say of labels.

    Args:
        cc: (N,).
        boxes_xyxy: (N, 4) px.
        scene: (4,) of `scene_vector`, of a camera of known height.

    Returns:
        (N, 2) log(k h / 1.5 m), nearly the logarithm of the height over 1.5 m, and log(L / 4.5 m); for a front of at
        least 1 px and a length of 0.5 to 40 m.
    """
    rows, nearness = _from_camera(boxes_xyxy, scene)
    tall = boxes_xyxy[:, 3] - boxes_xyxy[:, 1]
    k, m = ((1 - cc) * tall).clamp(min=1.0) / rows, cc * tall / rows
    # How far the vehicle reaches, in its distance: the inverse of `merge_sizes`.
    reach = m / (1 - k - m).clamp(min=1e-6) if scene[3] < 0 else m / (1 + k)
    length = (reach / (nearness * scene[1])).clamp(*_LENGTHS_M)
    return torch.stack([torch.log(k / (scene[1] * TYPICAL_HEIGHT_M)), torch.log(length / TYPICAL_LENGTH_M)], dim=1)


def merge_sizes(
    cc: Tensor, boxes_xyxy: Tensor, sizes: Tensor, scene: Tensor, *, weight: float, height_px: float
) -> tuple[Tensor, Tensor]:
    """c_c and box from what a network sees and from the sizes it says.

    The box's upper side becomes the mean of both. Nothing changes where the camera's height is not known, and where the
    picture's lower border cuts a box, which then does not end on the road.

    Args:
        cc: (N,) as seen.
        boxes_xyxy: (N, 4) px, likewise.
        sizes: (N, 2) of `sizes_from_cc`.
        scene: (4,) of `scene_vector`.
        weight: of the c_c that follows from the sizes, 0 to 1.
        height_px: of the picture.

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
    """F (N,), at least 1 px, and h / D (N,) of the boxes' lower sides."""
    rows = (boxes_xyxy[:, 3] - scene[0]).abs().clamp(min=1.0)
    return rows, (rows / scene[2]) ** -scene[3]
