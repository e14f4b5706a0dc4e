"""Which silhouettes of a background model move along the road, by the optical flow to other frames.

What differs from the empty scene need not be traffic. A camera that sways shows walls and markings beside their places
in the model, lights flicker, shadows tremble. The texture of such things stays where it is. So corners inside a
silhouette are followed to frames shortly before and after, and to one a second before; the camera's own movement is
subtracted. What can be followed nowhere is there for an instant only, and does not move either.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import CalibrationError
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.masks.background.channels import channel_max
from labelgen.masks.background.source import WORKING_WIDTH
from labelgen.masks.instances import InstanceMasks
from labelgen.media.klt import Grey, KltSettings, Points, optical_flow

__all__ = ["MOTION", "MotionThresholds", "find_moving", "working_grey"]


@dataclass(frozen=True)
class MotionThresholds:
    """Thresholds of what moves. Pixels are those of frames `WORKING_WIDTH` px wide.

    Args:
        look_s: seconds from one look at a thing to the next.
        near_s: seconds to frames shortly before and after. Over a longer time fast vehicles near the camera are lost;
            over a shorter one slow vehicles far away move less than can be measured.
        min_fps: frames per second below which moving vehicles can rarely be followed from one frame to the next. What
            cannot be followed then counts as moving.
        min_along_m: metres along the road from one look to the next that make a thing traffic.
        min_px: px; least movement that can be told from none.
        max_across_share: largest movement across the road, as a share of that along it.
        corners: number of corners in a silhouette.
        cells: the corners are taken from so many rows and columns of cells, so that no strong edge outvotes the rest.
        min_cell_px: px; least side of a cell.
        min_quality: least quality of a corner, as a share of the best in its mask. Flat areas lie below it, and would
            seem to stand still.
        corner_spacing_px: px; least distance between corners of a silhouette.
        min_followed: with fewer corners followed, the movement is not known.
        min_followed_share: the same, as a share of the corners.
        max_return_px: px; a corner counts as followed if it ends nearer than this to its start when followed back.
        min_agreeing_share: share of the followed corners that must move alike. A smaller one accepts a vehicle that
            shares its mask with a wall.
        agreement_share: corners move alike if they differ from the median by less than this share of it...
        agreement_px: ... or by less than this, px.
        scene_corners: number of corners around the silhouettes, from which the camera's movement is taken.
        scene_cells: the same as `cells` for these.
        scene_margin_px: px; least distance from a silhouette to them.
        min_scene_corners: with fewer of them followed, the camera counts as still.
        vehicle_width_m: metres; width of the vehicle that a mask stands for where the camera has no scale.
        flow: settings of the optical flow.
    """

    look_s: float = 1.0
    near_s: float = 0.1
    min_fps: float = 8.0
    min_along_m: float = 1.0
    min_px: float = 0.7
    max_across_share: float = 1.0
    corners: int = 9
    cells: int = 3
    min_cell_px: int = 12
    min_quality: float = 0.1
    corner_spacing_px: int = 3
    min_followed: int = 3
    min_followed_share: float = 0.3
    max_return_px: float = 0.7
    min_agreeing_share: float = 0.6
    agreement_share: float = 0.4
    agreement_px: float = 0.7
    scene_corners: int = 120
    scene_cells: int = 8
    scene_margin_px: int = 4
    min_scene_corners: int = 12
    vehicle_width_m: float = 1.9
    flow: KltSettings = field(default_factory=lambda: KltSettings(window_px=11))

    def can_follow(self, fps: float | None) -> bool:
        """Return whether vehicles can be followed from frame to frame; not where the rate is unknown."""
        return fps is not None and fps >= self.min_fps

    def offsets(self, fps: float | None) -> tuple[int, ...]:
        """Return differences of frame numbers to the frames that corners are followed to, in the order of use."""
        rate = fps or 1 / self.look_s
        near, look = (max(1, round(seconds * rate)) for seconds in (self.near_s, self.look_s))
        return tuple(dict.fromkeys((-near, near, -1, 1, -look)))

    def looks(self, offset: int, fps: float | None) -> float:
        """Return how many looks a difference of frame numbers is, at least 0."""
        return abs(offset) / max(1.0, self.look_s * (fps or 1 / self.look_s))


MOTION = MotionThresholds()


def working_grey(image: NDArray[np.uint8]) -> Grey:
    """Return the brightest channel of a frame (H, W, 3) uint8 BGR as (h, `WORKING_WIDTH`) uint8.

    Red and blue paint can be as light as the road; its brightest channel differs.
    """
    height, width = image.shape[:2]
    grey = channel_max(image)
    size = (WORKING_WIDTH, max(1, round(height * WORKING_WIDTH / width)))
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if width > WORKING_WIDTH else cv2.INTER_LINEAR)
    return np.asarray(grey, dtype=np.uint8)


def find_moving(
    masks: InstanceMasks,
    grey: Grey,
    others: Iterable[tuple[float, Grey]],
    camera: Camera,
    *,
    if_unknown: bool = False,
    thresholds: MotionThresholds = MOTION,
) -> NDArray[np.bool_]:
    """Return (N,) which masks move along the road.

    Args:
        masks: N masks of a frame.
        grey: the frame, see `working_grey`.
        others: other frames, each with its distance in looks. The first one to which a mask can be followed says
            whether it moves; where it does not seem to, those about a look away have the last word.
        camera: of the frame. Where it has no scale, the width of each mask is taken for a vehicle's.
        if_unknown: what masks count as that can be followed to none of the others.
        thresholds: of what moves.
    """
    moving, known = np.zeros((2, len(masks)), dtype=np.bool_)
    corners: _Corners | None = None
    for looks, other in others:
        # Over a short time some movements are too small; over a look all are large enough.
        open_cases = ~moving if looks >= 0.5 else ~known
        if not open_cases.any():
            continue
        corners = corners or _find_corners(masks, grey, thresholds)
        steps = _median_steps(corners.of(open_cases), grey, other, thresholds)
        for i, step in steps.items():
            known[i] = True
            moving[i] = float(np.hypot(*step)) >= thresholds.min_px and _is_along_road(
                masks.boxes_xyxy[i], step * masks.frame_wh[0] / WORKING_WIDTH, looks, camera, thresholds
            )
    return np.where(known, moving, if_unknown)


@dataclass(frozen=True, eq=False)
class _Corners:
    """Corners of a frame: (N, 2) float32 px, and (N,) the number of the mask that each lies in, -1 around them all."""

    points: Points
    owners: NDArray[np.int64]

    def of(self, masks: NDArray[np.bool_]) -> _Corners:
        """Return the corners in some of the masks (N,), and those around them all."""
        wanted = (self.owners < 0) | masks[self.owners]
        return _Corners(self.points[wanted], self.owners[wanted])


def _find_corners(masks: InstanceMasks, grey: Grey, thresholds: MotionThresholds) -> _Corners:
    factors = np.array(grey.shape[::-1]) / np.array(masks.frame_wh)
    quality = cv2.cornerMinEigenVal(grey, 3)
    spacing = 2 * thresholds.corner_spacing_px - 1
    quality[quality < cv2.dilate(quality, np.ones((spacing, spacing), np.uint8))] = 0
    scene = np.ones(grey.shape, dtype=np.uint8)
    corners = []
    for box, crop in zip(masks.boxes_xyxy, masks.crops, strict=True):
        x0, y0 = np.floor(box[:2] * factors).astype(int)
        x1, y1 = np.ceil(box[2:] * factors).astype(int)
        part = quality[y0:y1, x0:x1]
        inside = cv2.resize(crop.view(np.uint8), part.shape[::-1], interpolation=cv2.INTER_NEAREST)
        scene[y0:y1, x0:x1][inside > 0] = 0
        least = thresholds.min_quality * float(part.max())
        corners.append(_spread_corners(part * inside, least, thresholds) + np.array([x0, y0]))
    margin = np.ones((2 * thresholds.scene_margin_px + 1,) * 2, np.uint8)
    around = replace(thresholds, corners=thresholds.scene_corners, cells=thresholds.scene_cells)
    corners.append(_spread_corners(quality * cv2.erode(scene, margin), 0.0, around))
    owners = np.repeat([*range(len(masks)), -1], [len(own) for own in corners])
    return _Corners(np.concatenate(corners).astype(np.float32), owners)


def _spread_corners(quality: NDArray[np.float32], least: float, thresholds: MotionThresholds) -> Array:
    """Return places (N, 2) px of the best in each cell of a map of corner qualities, all better than `least`."""
    rows, columns = (max(1, min(thresholds.cells, side // thresholds.min_cell_px)) for side in quality.shape)
    count = -(-thresholds.corners // (rows * columns))
    corners = []
    for top, bottom in pairwise(np.linspace(0, quality.shape[0], rows + 1).astype(int)):
        for left, right in pairwise(np.linspace(0, quality.shape[1], columns + 1).astype(int)):
            y, x = np.nonzero(quality[top:bottom, left:right] > least)
            best = np.argsort(-quality[top:bottom, left:right][y, x], kind="stable")[:count]
            corners.append(np.stack([x[best] + left, y[best] + top], axis=1))
    return np.concatenate(corners).astype(np.float64)


def _median_steps(corners: _Corners, grey: Grey, other: Grey, thresholds: MotionThresholds) -> dict[int, Array]:
    """Return by mask how far (2,) px it moves to the other frame, where enough of its corners say so."""
    if not (corners.owners >= 0).any():
        return {}
    there, followed = _follow(grey, other, corners.points, thresholds)
    movement = there - _unmoved_places(corners, there, followed, thresholds)
    out = {}
    for i in np.unique(corners.owners[corners.owners >= 0]).tolist():
        own = corners.owners == i
        steps = movement[own & followed]
        if len(steps) < max(thresholds.min_followed, thresholds.min_followed_share * np.count_nonzero(own)):
            continue
        step = np.median(steps, axis=0)
        allowed_px = max(thresholds.agreement_px, thresholds.agreement_share * float(np.hypot(*step)))
        agreeing = np.hypot(*(steps - step).T) <= allowed_px
        if agreeing.mean() >= thresholds.min_agreeing_share:
            out[i] = step
    return out


def _follow(grey: Grey, other: Grey, points: Points, thresholds: MotionThresholds) -> tuple[Points, NDArray[np.bool_]]:
    """Return where points (N, 2) px are in the other frame, and (N,) whether they were followed there and back."""
    flow = thresholds.flow
    there, status = optical_flow(grey, other, points, points.copy(), flow, levels=flow.levels)
    back, status_back = optical_flow(other, grey, there, there.copy(), flow, levels=flow.levels)
    returned = np.hypot(*(back - points).T) <= thresholds.max_return_px
    return there, np.asarray(returned & (status[:, 0] > 0) & (status_back[:, 0] > 0))


def _unmoved_places(
    corners: _Corners, there: Points, followed: NDArray[np.bool_], thresholds: MotionThresholds
) -> Array:
    """Return (N, 2) px where the corners would be in the other frame if only the camera moved."""
    scene = followed & (corners.owners < 0)
    if np.count_nonzero(scene) >= thresholds.min_scene_corners:
        matrix, _ = cv2.estimateAffinePartial2D(
            corners.points[scene], there[scene], method=cv2.RANSAC, ransacReprojThreshold=thresholds.min_px
        )
        if matrix is not None:
            return np.asarray(corners.points @ matrix[:, :2].T + matrix[:, 2])
    return corners.points.astype(np.float64)


def _is_along_road(
    box: NDArray[np.int64], step_px: Array, looks: float, camera: Camera, thresholds: MotionThresholds
) -> bool:
    """Return whether a step (2,) moves a mask whose box is (4,) xyxy along the road, all in px of the frame."""
    foot = np.array([(box[0] + box[2]) / 2, box[3]], dtype=np.float64)
    scaled = camera if camera.scale is not None else replace(camera, scale=1.0)
    try:
        left, right, start, end = scaled.road_points(np.array([box[[0, 3]], box[[2, 3]], foot, foot + step_px]))
    except CalibrationError:
        return False
    metre = 1.0 if camera.scale is not None else float(np.hypot(*(right - left))) / thresholds.vehicle_width_m
    along_m, across_m = np.abs(end - start) / metre
    return bool(along_m >= thresholds.min_along_m * looks and across_m <= thresholds.max_across_share * along_m)
