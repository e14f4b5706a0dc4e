"""Rectification: the homography that makes two of the road's directions axis-parallel.

Convention:
    Points are (..., 2) float64 px as x, y, x right, y down; boxes (..., 4) as x0, y0, x1, y1. Pixels are areas (see
    `labelgen.geometry.camera`). Sizes are (width, height), images (H, W) or (H, W, C), masks (H, W).
    Matrices are (3, 3) float64, act on column vectors (x, y, 1) and map frame px to rectified px. They are signed so
    that the third coordinate is positive on the road.

Source: Kocur & Ftacnik 2020, section 3.2 (road mask and coverage rule, the frame being what must be covered);
Kocur 2019 (whole frame).
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
from labelgen.geometry.rectifying_homography import rectify_windows
from labelgen.geometry.road_mask import RoadMask

__all__ = ["CROP_STEP", "MIN_COVERAGE", "Rectification"]

CROP_STEP = 5
"""Rows cropped from the road mask's bottom per step of the coverage rule, px: more are faster and crop more."""
MIN_COVERAGE = 0.8
"""Least share of the rectified image that lies inside the frame (paper section 3.2): more crops more of the road."""


@dataclass(frozen=True, eq=False)
class Rectification:
    """A rectifying homography, which warps points, boxes, images and masks both ways.

    Args:
        pair: the vanishing points whose directions become axis-parallel.
        size_wh: size of the rectified image, px.
        matrix: (3, 3) frame px -> rectified px, of either sign; stored with the sign of the convention above.
        vpu: (2,) rectified px, the unused vanishing point.
        frame_wh: size of the frame, px, where known.
        frame_coverage: share of the rectified image that lies inside the frame; NaN where unknown.
        road_area: share of the rectified image that is road (of the uncropped mask); NaN without a mask.
        crop_steps: number of steps by which the coverage rule cropped the mask's bottom.

    Raises:
        RectificationError: a matrix or VPU of another shape, not finite or not invertible; a size that is not positive.
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
        """Return the rectification of the road, of the whole frame, or none: the frame resized.

        Args:
            region: what to rectify.
            camera: of the frame.
            road: the road mask; its size is the frame's.
            pair: the vanishing points whose directions become axis-parallel.
            size_wh: size of the rectified image, px.

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
        """Return the rectification around a road mask (Kocur & Ftacnik 2020, section 3.2).

        The mask is cropped from the bottom until enough of the rectified image is covered.

        Args:
            camera: of the frame.
            mask: (H, W) or (H, W, C) of the frame's size.
            pair: the vanishing points whose directions become axis-parallel.
            size_wh: size of the rectified image, px.
            cover: what must be covered: "frame", as for the published numbers; or "mask", as the paper's text says,
                which most VP2-VP3 scenes never reach.
            min_coverage: least share of the rectified image inside it.
            crop_step: rows cropped at a time.

        Raises:
            RectificationError: the mask is empty or of another size than the frame, a vanishing point lies inside its
                hull, the line that joins the two crosses it, or nothing of it is left.
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
                continue  # the rows beside the camera are cropped like those outside the frame
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
        """Return the rectification of a rectangle of the frame, without road mask and coverage rule.

        The rectangle is the whole frame for the method of Kocur 2019 (Previous2D, Previous3D) and the crop for
        BoxCars116k.

        Args:
            camera: of the frame.
            window_xyxy: (4,) frame px.
            pair: the vanishing points whose directions become axis-parallel.
            size_wh: size of the rectified image, px.

        Raises:
            RectificationError: the window has no area, a vanishing point lies inside it, or the line that joins the
                two crosses it.
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
        """(4, 2) frame px, the rectified image's corners: top left, top right, bottom right, bottom left."""
        w, h = self.size_wh
        return self.points_back(np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64))

    def _coverage_of_frame(self) -> float:
        assert self.frame_wh is not None
        (w, h), (frame_w, frame_h) = self.size_wh, self.frame_wh
        covered = np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64)
        # A rectified point comes from (x, y, w) in the frame. The frame's borders, x >= 0 or x <= frame_w * w, are
        # lines of the rectified image, too, and all four together imply w >= 0.
        x, y, scale = self.inverse
        for border in (x, y, frame_w * scale - x, frame_h * scale - y):
            covered = clip_polygon(covered, border)
        return float(shapely.Polygon(covered).area) / (w * h) if len(covered) > 2 else 0.0

    # -- warping, both ways -------------------------------------------------------------------------

    def points(self, points_px: ArrayLike) -> Array:
        """Map frame px (..., 2) to rectified px; NaN on and beyond the line that maps to infinity."""
        return _map(self.matrix, points_px)

    def polygon_inside(self, polygon_px: ArrayLike) -> Array:
        """Return the part (J, 2), rectified px, of a convex frame polygon (K, 2) inside the image; J may be 0."""
        (w, h), (x, y, depth) = self.size_wh, self.matrix
        inside = np.asarray(polygon_px, dtype=np.float64)
        for border in (depth, x, w * depth - x, y, h * depth - y):
            inside = clip_polygon(inside, border)
        return np.clip(self.points(inside), 0, self.size_wh)

    def points_back(self, points_rectified: ArrayLike) -> Array:
        """Map rectified px (..., 2) to frame px."""
        return _map(self.inverse, points_rectified)

    def boxes(self, boxes_xyxy: ArrayLike) -> Array:
        """Return the axis-aligned boxes (N, 4), rectified px, around frame boxes (N, 4)."""
        return bounding_boxes(self.points(_box_corners(boxes_xyxy)))

    def boxes_back(self, boxes_xyxy: ArrayLike) -> Array:
        """Return the axis-aligned boxes (N, 4), frame px, around rectified boxes (N, 4)."""
        return bounding_boxes(self.points_back(_box_corners(boxes_xyxy)))

    def pixel_matrix(self, origin_px: tuple[float, float] = (0.0, 0.0)) -> Array:
        """Return the matrix (3, 3) for OpenCV, whose coordinates are those of pixel centres.

        Args:
            origin_px: frame px of the image's first pixel.
        """
        x, y = origin_px
        return translation(-0.5, -0.5) @ self.matrix @ translation(x + 0.5, y + 0.5)

    def warp_image(
        self,
        image: NDArray[Any],
        *,
        origin_px: tuple[float, float] = (0.0, 0.0),
        interpolation: int = cv2.INTER_LINEAR,
    ) -> NDArray[Any]:
        """Warp an image of the frame, or a part of it, into the rectified image.

        Args:
            image: (H, W) or (H, W, C).
            origin_px: frame px of the image's first pixel.
            interpolation: OpenCV's flag.

        Returns:
            (h, w) or (h, w, C) of the rectified size and the image's type; 0 outside the image.
        """
        out = cv2.warpPerspective(image, self.pixel_matrix(origin_px), self.size_wh, flags=interpolation)
        return np.asarray(out)

    def warp_image_back(self, image: NDArray[Any], frame_wh: tuple[int, int] | None = None) -> NDArray[Any]:
        """Warp a rectified image back into the frame.

        Args:
            image: (h, w) or (h, w, C) of the rectified size.
            frame_wh: size of the frame, px; None for the one that is stored.

        Returns:
            (H, W) or (H, W, C); 0 outside the rectified image.

        Raises:
            RectificationError: the frame's size is not known.
        """
        size = frame_wh or self.frame_wh
        if size is None:
            raise RectificationError("the frame's size is not known; pass frame_wh", parameter="frame_wh")
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(image, self.pixel_matrix(), size, flags=flags))

    def warp_mask(self, mask: NDArray[Any], *, origin_px: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.bool_]:
        """Warp a mask (H, W), any non-zero value being set, into the rectified image: bilinear, thresholded at half."""
        return self.warp_image(_levels(mask), origin_px=origin_px) >= 128

    def warp_mask_back(self, mask: NDArray[Any], frame_wh: tuple[int, int] | None = None) -> NDArray[np.bool_]:
        """Warp a rectified mask (h, w), any non-zero value being set, back into the frame; see `warp_image_back`."""
        return self.warp_image_back(_levels(mask), frame_wh) >= 128


def _check_size(size_wh: tuple[int, int]) -> None:
    if not all(n > 0 for n in size_wh):
        raise RectificationError(f"rectification: expected a size of two positive numbers, got {size_wh}")


def _levels(mask: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a mask as 0 and 255."""
    return np.where(mask, np.uint8(255), np.uint8(0))


def _map(matrix: Array, points: ArrayLike) -> Array:
    pts = np.asarray(points, dtype=np.float64)
    return apply_homography(matrix, pts.reshape(-1, 2)).reshape(pts.shape)


def _visible_sign(matrix: Array, size_wh: tuple[int, int]) -> float:
    """Return the sign that makes the third coordinate positive at the rectified image's centre; 0 if singular."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    # Third row of the adjugate times the centre: the depth there up to the determinant's sign.
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
    """Return whether the infinite line through two points touches a convex hull (K, 2)."""
    direction = end - start
    sides = direction[0] * (hull[:, 1] - start[1]) - direction[1] * (hull[:, 0] - start[0])
    return not (bool((sides > 0).all()) or bool((sides < 0).all()))
