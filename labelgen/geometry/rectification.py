"""Rectification: the homography that makes two of the road's directions axis-parallel.

Convention: pixels are areas (see `camera`); matrices are float64, act on column vectors (x, y, 1) and map
frame pixels to rectified pixels. They are signed so that the third coordinate is positive on the road.

Source: Kocur & Ftacnik 2020, section 3.2 (mask and coverage rule, with the frame as what must be covered);
Kocur 2019 (whole frame); both keep the vertical direction of traffic.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from labelgen.choices import Pair, Region
from labelgen.errors import RectificationError
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array, apply_homography, bounding_boxes, clip_polygon, translation
from labelgen.geometry.road_mask import RoadMask

__all__ = ["CROP_STEP", "MIN_COVERAGE", "Rectification", "rectify_windows"]

CROP_STEP = 5
"""Rows cropped from the road mask's bottom per step of the coverage rule."""
MIN_COVERAGE = 0.8
"""Share of the rectified image that the coverage rule asks for."""


def rectify_windows(
    vps: ArrayLike, hulls: ArrayLike, pair: Pair, size_wh: tuple[int, int]
) -> tuple[Array, NDArray[np.bool_]]:
    """Rectifying homographies of N convex regions at once; the one formula behind every variant.

    The region's bounding tangents through the two vanishing points become the borders of the target, with
    the side that is lower in the frame at the bottom and without a reflection.

    Args:
        vps: (N, 3, 2) or (3, 2) px, VP1, VP2, VP3.
        hulls: (N, K, 2) px, points whose convex hull is the region.
        pair: which vanishing points go to infinity.
        size_wh: target size, px.

    Returns:
        matrices (N, 3, 3), and valid (N,): False where the line joining the two vanishing points crosses
        the region, or the region has no area; such matrices are NaN.
    """
    hulls = np.asarray(hulls, dtype=np.float64)
    vps = np.broadcast_to(np.asarray(vps, dtype=np.float64), (len(hulls), 3, 2))
    # Work in coordinates of order one: vanishing points reach 1e5 px.
    boxes = bounding_boxes(hulls)
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    unit = np.maximum((boxes[:, 2:] - boxes[:, :2]).max(axis=1), 1e-9)
    points = np.concatenate([(hulls - centre[:, None]) / unit[:, None, None], np.ones((*hulls.shape[:2], 1))], -1)
    vps_h = np.concatenate([(vps - centre[:, None]) / unit[:, None, None], np.ones((*vps.shape[:2], 1))], -1)
    vps_h /= np.linalg.norm(vps_h, axis=-1, keepdims=True)

    horizontal, vertical = vps_h[:, 1], vps_h[:, pair.vertical - 1]
    inner = points.mean(axis=1)
    spread = (points - inner[:, None])[..., :2]
    # Sum of squares of a region one unit long, so its determinant tells how thin it is.
    with np.errstate(invalid="ignore"):
        flat_region = np.linalg.det(np.swapaxes(spread, -1, -2) @ spread) < 1e-12
    to_infinity = np.cross(horizontal, vertical)
    basis = np.stack([np.cross(vertical, inner), np.cross(horizontal, inner), to_infinity], axis=1)
    norm = np.linalg.norm(basis, axis=-1, keepdims=True)
    basis /= np.where(norm > 0, norm, 1)
    basis *= np.sign(np.einsum("ni,ni->n", basis[:, 2], inner))[:, None, None]
    mapped = points @ np.swapaxes(basis, -1, -2)
    w = mapped[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = mapped[..., :2] / w[..., None]
    # Directions: no reflection (positive determinant), and what moves down the frame along lines through the
    # vertical vanishing point moves down the output.
    along = vertical[:, :2] * inner[:, 2:] - inner[:, :2] * vertical[:, 2:]
    along *= np.where(along[:, 1:] < 0, -1.0, 1.0)
    up = np.where(np.einsum("ni,ni->n", basis[:, 1, :2], along) >= 0, 1.0, -1.0)
    with np.errstate(invalid="ignore"):
        right = up * np.where(np.linalg.det(basis) >= 0, 1.0, -1.0)
    basis[:, 0] *= right[:, None]
    basis[:, 1] *= up[:, None]
    flat = flat * np.stack([right, up], axis=1)[:, None]
    low, high = flat.min(axis=1), flat.max(axis=1)
    extent = high - low
    valid = ~flat_region & (w > 1e-9).all(axis=1) & (extent > 1e-12).all(axis=1) & np.isfinite(extent).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.asarray(size_wh, dtype=np.float64) / extent
        to_target = np.zeros((len(points), 3, 3))
        to_target[:, 0, 0], to_target[:, 1, 1], to_target[:, 2, 2] = gain[:, 0], gain[:, 1], 1.0
        to_target[:, :2, 2] = -low * gain
        to_unit = np.zeros((len(points), 3, 3))
        to_unit[:, 0, 0] = to_unit[:, 1, 1] = 1 / unit
        to_unit[:, :2, 2] = -centre / unit[:, None]
        to_unit[:, 2, 2] = 1.0
        matrices = to_target @ basis @ to_unit
        matrices /= np.linalg.norm(matrices, axis=(-2, -1), keepdims=True)
    matrices[~valid] = np.nan
    return matrices, valid


@dataclass(frozen=True, eq=False)
class Rectification:
    """One homography, with everything needed to use it in both directions.

    Args:
        pair: the vanishing points made axis-parallel.
        size_wh: size of the rectified image, px.
        matrix: (3, 3) frame px -> rectified px, of either sign; kept with the sign of the convention above.
        vpu: (2,) the unused vanishing point in rectified px.
        frame_wh: size of the frame, px.
        frame_coverage: share of the rectified image that lies inside the frame.
        road_area: share of the rectified image that is road (of the uncropped mask); NaN without a mask.
        crop_steps: how many steps the coverage rule cropped from the mask's bottom.

    Raises:
        RectificationError: a matrix or VPU that is not finite or not invertible.
    """

    pair: Pair
    size_wh: tuple[int, int]
    matrix: Array
    vpu: Array
    frame_wh: tuple[int, int] | None = None
    frame_coverage: float = math.nan
    road_area: float = math.nan
    crop_steps: int = 0

    def __post_init__(self) -> None:
        matrix, vpu = np.array(self.matrix, dtype=np.float64), np.array(self.vpu, dtype=np.float64)
        if matrix.shape != (3, 3) or vpu.shape != (2,) or not (np.isfinite(matrix).all() and np.isfinite(vpu).all()):
            raise RectificationError(
                f"rectification: expected a finite 3x3 matrix and VPU, got {matrix.tolist()}, {vpu.tolist()}"
            )
        _check_size(self.size_wh)
        sign = _visible_sign(matrix, self.size_wh)
        if sign == 0:
            raise RectificationError("rectification: the matrix is singular")
        np.multiply(matrix, sign, out=matrix)
        for array in (matrix, vpu):
            array.setflags(write=False)
        for key, value in {"matrix": matrix, "vpu": vpu}.items():
            object.__setattr__(self, key, value)

    @cached_property
    def inverse(self) -> Array:
        """(3, 3) rectified px -> frame px."""
        inverse = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        inverse.setflags(write=False)
        return inverse

    # -- constructors -------------------------------------------------------------------------------

    @classmethod
    def of_region(
        cls, region: Region, camera: Camera, road: RoadMask, pair: Pair, size_wh: tuple[int, int]
    ) -> Rectification:
        """Rectification of a scene's road, of the whole frame as in the earlier method, or none: the frame resized.

        Raises:
            RectificationError: see `from_road_mask` and `from_window`.
        """
        if region is Region.ROAD:
            return cls.from_road_mask(camera, road, pair, size_wh)
        if region is Region.FRAME:
            return cls.from_window(camera, [0, 0, *road.size_wh], pair, size_wh)
        _check_size(size_wh)
        factors = np.divide(size_wh, road.size_wh)
        vpu = camera.vanishing_point(pair.unused) * factors
        return cls(pair, size_wh, np.diag([*factors, 1.0]), vpu, road.size_wh, 1.0, float(road.pixels.mean()))

    @classmethod
    def from_road_mask(
        cls,
        camera: Camera,
        mask: RoadMask | NDArray[Any],
        pair: Pair,
        size_wh: tuple[int, int],
        *,
        cover: Literal["frame", "mask"] = "frame",
        min_coverage: float = MIN_COVERAGE,
        crop_step: int = CROP_STEP,
    ) -> Rectification:
        """Rectification around a road mask (paper section 3.2).

        The mask is cropped from the bottom, `crop_step` rows at a time, until `min_coverage` of the output
        lies inside the camera frame (`cover="frame"`, what the published numbers used) or inside the mask
        itself (`cover="mask"`, what the paper's text says; most VP2-VP3 scenes never reach it).

        Raises:
            RectificationError: the mask is empty or of another size than the frame, a vanishing point lies
                inside it, the line joining the two crosses it, or it is cropped away.
        """
        if crop_step < 1:
            raise RectificationError(f"rectification: expected crop_step >= 1, got {crop_step}")
        _check_size(size_wh)
        road = mask if isinstance(mask, RoadMask) else RoadMask(mask)
        if camera.image_wh is not None and road.size_wh != tuple(camera.image_wh):
            raise RectificationError(
                f"road mask: it is {road.size_wh[0]}x{road.size_wh[1]} px, but the frame is "
                f"{camera.image_wh[0]}x{camera.image_wh[1]}; give a mask of the frame's size"
            )
        _check_vanishing_points_outside(camera, road.hull(), pair, "the road mask")
        if _line_crosses(camera.vp1, camera.vp2, road.hull()):
            raise RectificationError(
                "road mask: the horizon, the line joining VP1 and VP2, crosses the road mask; mark only road below it"
            )
        crossed = _line_crosses(camera.vp2, camera.vanishing_point(pair.vertical), road.hull())
        for step in itertools.count():
            below = road.bottom - step * crop_step
            if below <= road.rows[0]:
                break
            hull = road.hull(below)
            if crossed and _line_crosses(camera.vp2, camera.vanishing_point(pair.vertical), hull):
                continue  # what lies abreast of the camera is cropped like what lies outside the frame
            rect = cls._from_hull(camera, hull, pair, size_wh, road.size_wh, step)
            if cover == "frame" and rect.frame_coverage < min_coverage:
                continue
            if cover == "mask" and rect.warp_mask(road.cropped(below)).mean() < min_coverage:
                continue
            return replace(rect, road_area=float(rect.warp_mask(road.pixels).mean()))
        reason = f"; the line joining VP2 and VP{pair.vertical} crosses it" if crossed else ""
        raise RectificationError(
            f"road mask: cropped away before {min_coverage:.0%} of the {pair} output lay inside the {cover}{reason}; "
            "mark less of the road near the camera"
        )

    @classmethod
    def from_window(cls, camera: Camera, window_xyxy: ArrayLike, pair: Pair, size_wh: tuple[int, int]) -> Rectification:
        """Rectification of a whole rectangle of the frame, without mask or coverage rule.

        With the whole frame it is the earlier method (rows Previous2D and Previous3D); with a crop's
        rectangle it is how BoxCars crops are rectified.

        Raises:
            RectificationError: the line joining the two vanishing points crosses the window.
        """
        _check_size(size_wh)
        x0, y0, x1, y1 = (float(v) for v in np.asarray(window_xyxy, dtype=np.float64))
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        if not (np.isfinite(corners).all() and x0 < x1 and y0 < y1):
            raise RectificationError(
                f"window: expected finite x0 < x1 and y0 < y1, got {[x0, y0, x1, y1]}; a window without area has no "
                "rectification"
            )
        _check_vanishing_points_outside(camera, corners, pair, "the window")
        if _line_crosses(camera.vp2, camera.vanishing_point(pair.vertical), corners):
            raise RectificationError(
                f"{pair}: the line joining VP2 and VP{pair.vertical} crosses the window; use a window on one side of it"
            )
        frame_wh = (math.ceil(x1), math.ceil(y1)) if camera.image_wh is None else camera.image_wh
        return cls._from_hull(camera, corners, pair, size_wh, frame_wh, 0)

    @classmethod
    def _from_hull(
        cls,
        camera: Camera,
        hull: Array,
        pair: Pair,
        size_wh: tuple[int, int],
        frame_wh: tuple[int, int],
        step: int,
    ) -> Rectification:
        vps = np.stack([camera.vp1, camera.vp2, camera.vp3])
        matrices, valid = rectify_windows(vps, hull[None], pair, size_wh)
        if not valid[0]:
            raise RectificationError(
                f"{pair}: the line joining the two vanishing points crosses the region to rectify, or the region has "
                "no area; mark only road that lies on one side of it"
            )
        vpu = apply_homography(matrices[0], camera.vanishing_point(pair.unused)[None], behind="keep")[0]
        rect = cls(pair, size_wh, matrices[0], vpu, frame_wh, crop_steps=step)
        return replace(rect, frame_coverage=rect._coverage_of_frame())

    # -- coverage -----------------------------------------------------------------------------------

    @property
    def corners_px(self) -> Array:
        """(4, 2) the rectified image's corners in frame pixels: top left, top right, bottom right, bottom left."""
        w, h = self.size_wh
        return self.points_back(np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64))

    def _coverage_of_frame(self) -> float:
        assert self.frame_wh is not None
        (w, h), (frame_w, frame_h) = self.size_wh, self.frame_wh
        seen = np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64)
        # Where a rectified point comes from is (x, y, w); the frame's four borders, as x >= 0 or x <= frame_w * w,
        # are lines of the rectified image too, and together they leave only w >= 0.
        x, y, scale = self.inverse
        for border in (x, y, frame_w * scale - x, frame_h * scale - y):
            seen = clip_polygon(seen, border)
        return float(shapely.Polygon(seen).area) / (w * h) if len(seen) > 2 else 0.0

    # -- warping, both ways -------------------------------------------------------------------------

    def points(self, points_px: ArrayLike) -> Array:
        """Frame px (..., 2) -> rectified px; NaN beyond the line that goes to infinity."""
        return _map(self.matrix, points_px)

    def polygon_inside(self, polygon_px: ArrayLike) -> Array:
        """The part of a convex frame polygon (K, 2) that lies in the rectified image, rectified px (J, 2), J >= 0."""
        (w, h), (x, y, depth) = self.size_wh, self.matrix
        inside = np.asarray(polygon_px, dtype=np.float64)
        for border in (depth, x, w * depth - x, y, h * depth - y):
            inside = clip_polygon(inside, border)
        return np.clip(self.points(inside), 0, self.size_wh)

    def points_back(self, points_rectified: ArrayLike) -> Array:
        """Rectified px (..., 2) -> frame px."""
        return _map(self.inverse, points_rectified)

    def boxes(self, boxes_xyxy: ArrayLike) -> Array:
        """Frame boxes (N, 4) -> the axis-aligned boxes (N, 4) around them in the rectified image."""
        return bounding_boxes(self.points(_box_corners(boxes_xyxy)))

    def boxes_back(self, boxes_xyxy: ArrayLike) -> Array:
        """Rectified boxes (N, 4) -> the axis-aligned boxes (N, 4) around them in the frame."""
        return bounding_boxes(self.points_back(_box_corners(boxes_xyxy)))

    def pixel_matrix(self, origin_px: tuple[float, float] = (0.0, 0.0)) -> Array:
        """The matrix for OpenCV, whose coordinates name pixel centres, for an image that starts at `origin_px`."""
        x, y = origin_px
        return translation(-0.5, -0.5) @ self.matrix @ translation(x + 0.5, y + 0.5)

    def warp_image(
        self,
        image: NDArray[Any],
        *,
        origin_px: tuple[float, float] = (0.0, 0.0),
        interpolation: int = cv2.INTER_LINEAR,
    ) -> NDArray[Any]:
        """Rectify an image (H, W[, C]) whose first pixel lies at `origin_px` of the frame; black outside."""
        out = cv2.warpPerspective(image, self.pixel_matrix(origin_px), self.size_wh, flags=interpolation)
        return np.asarray(out)

    def warp_image_back(self, image: NDArray[Any], frame_wh: tuple[int, int] | None = None) -> NDArray[Any]:
        """Put a rectified image back into the frame; black outside."""
        size = frame_wh or self.frame_wh
        if size is None:
            raise RectificationError("warp_image_back: the frame's size is not known; pass frame_wh")
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(image, self.pixel_matrix(), size, flags=flags))

    def warp_mask(self, mask: NDArray[Any], *, origin_px: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.bool_]:
        """Rectify a mask (H, W), any non-zero value being set: linear interpolation, cut at half."""
        return self.warp_image(_levels(mask), origin_px=origin_px) >= 128

    def warp_mask_back(self, mask: NDArray[Any], frame_wh: tuple[int, int] | None = None) -> NDArray[np.bool_]:
        """Put a rectified mask, any non-zero value being set, back into the frame."""
        return self.warp_image_back(_levels(mask), frame_wh) >= 128


def _check_size(size_wh: tuple[int, int]) -> None:
    if not all(n > 0 for n in size_wh):
        raise RectificationError(f"rectification: expected a size of two positive numbers, got {size_wh}")


def _levels(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """A mask as 0 and 255."""
    return np.where(mask, np.uint8(255), np.uint8(0))


def _map(matrix: Array, points: ArrayLike) -> Array:
    pts = np.asarray(points, dtype=np.float64)
    return apply_homography(matrix, pts.reshape(-1, 2)).reshape(pts.shape)


def _visible_sign(matrix: Array, size_wh: tuple[int, int]) -> float:
    """The sign that makes the third coordinate positive where the rectified image's centre lies; 0 if singular."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    # The third row of the adjugate, on the centre: the depth there, but for the determinant's sign.
    depth = (d * h - e * g) * size_wh[0] / 2 + (b * g - a * h) * size_wh[1] / 2 + (a * e - b * d)
    return float(np.sign(det) * np.sign(depth)) if depth else float(np.sign(det))


def _box_corners(boxes_xyxy: ArrayLike) -> Array:
    boxes = np.asarray(boxes_xyxy, dtype=np.float64)
    return boxes[..., [0, 1, 2, 1, 2, 3, 0, 3]].reshape(*boxes.shape[:-1], 4, 2)


def _check_vanishing_points_outside(camera: Camera, hull: Array, pair: Pair, what: str) -> None:
    polygon = shapely.Polygon(hull)
    for number in (2, pair.vertical):
        if polygon.intersects(shapely.Point(camera.vanishing_point(number))):
            at = ", ".join(f"{v:.0f}" for v in camera.vanishing_point(number))
            raise RectificationError(
                f"{pair}: VP{number} at ({at}) lies inside {what}'s hull; mark only road that ends before it"
            )


def _line_crosses(start: Array, end: Array, hull: Array) -> bool:
    """Whether the infinite line through two points touches a convex hull (K, 2)."""
    direction = end - start
    sides = direction[0] * (hull[:, 1] - start[1]) - direction[1] * (hull[:, 0] - start[0])
    return not (bool((sides > 0).all()) or bool((sides < 0).all()))
