"""The ways, published and earlier, from a vehicle's box to its measured point on the road.

    transform3d   rectified 2D box and c_c -> 3D box -> middle of its bottom front edge
    transform2d   middle of the rectified 2D box's lower side
    orig2d        middle of the lower side of the 2D box in the frame
    maskrcnn3d    3D box around each instance mask, built in the mask's own window of the frame
    previous3d    as transform3d, with the whole frame rectified instead of the road
    previous2d    as transform2d, likewise
    dubska        as maskrcnn3d, around the blobs of a background model
    sochor        as dubska, around those blobs that detections say are vehicles

Source: Kocur & Ftacnik 2020, section 4; Kocur 2019 (the whole frame); Dubska et al. 2014; Sochor et al. 2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.speed.contact_point import MaskExtent, move_to_contact_point
from detector.speed.detections import Detections
from labelgen.errors import CalibrationError, LabelgenError
from labelgen.geometry import Camera, Pair, Rectification, Region, RoadMask, decode_boxes
from labelgen.geometry.boxes import CUT_MARGIN_PX
from labelgen.geometry.homography import Array

__all__ = ["MeasurementView", "Variant"]


class Variant(StrEnum):
    """How a vehicle's measured point is found."""

    TRANSFORM3D = "transform3d"
    TRANSFORM2D = "transform2d"
    ORIG2D = "orig2d"
    MASKRCNN3D = "maskrcnn3d"
    PREVIOUS3D = "previous3d"
    PREVIOUS2D = "previous2d"
    DUBSKA = "dubska"
    SOCHOR = "sochor"

    @classmethod
    def parse(cls, text: str) -> Variant:
        """Variant from its name; LabelgenError names the known ones."""
        for variant in cls:
            if variant.value == text.strip().lower():
                return variant
        raise LabelgenError(f"--variant {text}: unknown variant; use one of {', '.join(v.value for v in cls)}")

    @property
    def in_frame(self) -> bool:
        """Whether boxes lie in the frame itself, so that nothing is rectified as a whole."""
        return self is Variant.ORIG2D or self.from_tangents

    @property
    def is_3d(self) -> bool:
        """Whether it makes 3D boxes."""
        return self in (Variant.TRANSFORM3D, Variant.PREVIOUS3D) or self.from_tangents

    @property
    def from_tangents(self) -> bool:
        """Whether its 3D boxes are built around outlines in the frame."""
        return self in (Variant.MASKRCNN3D, Variant.DUBSKA, Variant.SOCHOR)

    @property
    def region(self) -> Region:
        """What is rectified."""
        if self.in_frame:
            return Region.NONE
        return Region.FRAME if self in (Variant.PREVIOUS3D, Variant.PREVIOUS2D) else Region.ROAD

    @property
    def from_c_c(self) -> bool:
        """Whether its 3D boxes come from 2D boxes and c_c."""
        return self.is_3d and not self.in_frame


@dataclass(frozen=True, eq=False)
class MeasurementView:
    """The picture in which a variant's boxes lie and are tracked, and the way from it back to the frame.

    Args:
        variant: the way.
        camera: with a scale and the size of its frame.
        rectification: of the frame; None where boxes lie in the frame.
        mask_extent: what the masks cover, for boxes that end with the outline of a mask. Measured points are then
            moved to the contact point (`detector.speed.contact_point`), except those of `orig2d`. None for boxes that
            end at the edge of a 3D box on the road.

    Raises:
        CalibrationError: the camera has no scale, or does not know its frame's size.
    """

    variant: Variant
    camera: Camera
    rectification: Rectification | None
    mask_extent: MaskExtent | None = None

    def __post_init__(self) -> None:
        if self.camera.image_wh is None:
            raise CalibrationError(f"camera {self.camera.name or '(unnamed)'}: its frame's size is not known")
        # Asking for the height asks for the scale.
        _ = self.camera.height_m

    @classmethod
    def create(
        cls,
        variant: Variant,
        camera: Camera,
        road: RoadMask,
        pair: Pair,
        size_wh: tuple[int, int],
        *,
        mask_extent: MaskExtent | None = None,
    ) -> MeasurementView:
        """The view of a scene.

        Raises:
            CalibrationError: as above.
            RectificationError: the scene admits no such rectification.
        """
        if variant.in_frame:
            return cls(variant, camera, None, mask_extent)
        return cls(variant, camera, Rectification.of_region(variant.region, camera, road, pair, size_wh), mask_extent)

    @property
    def frame_wh(self) -> tuple[int, int]:
        """Size of the frame, px."""
        assert self.camera.image_wh is not None
        return self.camera.image_wh

    @property
    def size_wh(self) -> tuple[int, int]:
        """Size of the picture in which the boxes lie, px."""
        return self.frame_wh if self.rectification is None else self.rectification.size_wh

    def to_frame(self, points: ArrayLike) -> Array:
        """Points (..., 2) of the view -> frame px."""
        if self.rectification is None:
            return np.asarray(points, dtype=np.float64)
        return self.rectification.points_back(points)

    def place(
        self,
        frame: int,
        time_s: float,
        boxes_xyxy: ArrayLike,
        cc: ArrayLike | None = None,
        scores: ArrayLike | None = None,
        class_ids: ArrayLike | None = None,
        vertices_px: ArrayLike | None = None,
    ) -> tuple[Detections, NDArray[np.bool_]]:
        """Detections of a frame with their place on the road.

        Args:
            frame, time_s: number and time stamp.
            boxes_xyxy: (N, 4) in the view.
            cc: (N,) for variants that decode it.
            scores: (N,) in [0, 1]; 1 where left out.
            class_ids: (N,) `labelgen.labels.VehicleClass`; 0 where left out.
            vertices_px: (N, 8, 2) frame px, ready-made 3D boxes, for variants that build them around outlines.

        Returns:
            the valid detections, and valid (N,): False where the box has no area or no 3D box fits into it.
        """
        boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
        n = len(boxes)
        weights = np.ones(n) if scores is None else np.asarray(scores, dtype=np.float64)
        classes = np.zeros(n, dtype=np.uint8) if class_ids is None else np.asarray(class_ids, dtype=np.uint8)
        shares, vertices, front = self._boxes_3d(boxes, cc, vertices_px)
        feet = self._middles(front)
        if self.mask_extent is not None and self.variant is not Variant.ORIG2D:
            feet = move_to_contact_point(self.camera, feet, self.mask_extent)
        solid = np.isfinite(boxes).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
        valid = np.asarray(solid & np.isfinite(front).all(axis=(1, 2)) & np.isfinite(feet).all(axis=1))
        found = Detections(
            frame,
            time_s,
            boxes_xyxy=boxes[valid],
            cc=shares[valid],
            scores=weights[valid],
            class_ids=classes[valid],
            vertices_px=vertices[valid],
            front_edges_px=self.to_frame(front[valid]),
            contact_points_px=feet[valid],
            contact_visible=self._whole(boxes[valid]),
        )
        return found, valid

    def _boxes_3d(self, boxes: Array, cc: Any, vertices_px: Any) -> tuple[Array, Array, Array]:
        """c_c (N,), 3D boxes (N, 8, 2) in frame px, bottom front edges (N, 2, 2) in the view; NaN for none."""
        n = len(boxes)
        unknown, nowhere = np.full(n, np.nan), np.full((n, 8, 2), np.nan)
        if not self.variant.is_3d:
            return unknown, nowhere, boxes[:, [0, 3, 2, 3]].reshape(-1, 2, 2)
        if not self.variant.from_c_c:
            vertices = nowhere if vertices_px is None else np.asarray(vertices_px, dtype=np.float64).reshape(-1, 8, 2)
            return unknown, vertices, vertices[:, 4:6]
        assert self.rectification is not None
        shares = unknown if cc is None else np.asarray(cc, dtype=np.float64).reshape(-1)
        decoded, fits = decode_boxes(boxes, shares, self.rectification.vpu)
        decoded[~fits] = np.nan
        return shares, self.to_frame(decoded), decoded[:, 4:6]

    def _middles(self, ends: Array) -> Array:
        """Frame px (N, 2) of the middles of bottom front edges whose ends (N, 2, 2) lie in the view."""
        if self.variant.from_tangents:
            # Halves are halves on the road, not in a picture that shows the edge in perspective.
            return self.camera.project(self.camera.road_points(ends, invalid="nan").mean(axis=1))
        return self.to_frame(ends.mean(axis=1))

    def _whole(self, boxes: Array) -> NDArray[np.bool_]:
        """(N,) False where the view's lower border cuts off the foot: there the box does not end on the road."""
        if self.rectification is None:
            return np.ones(len(boxes), dtype=np.bool_)
        return np.asarray(boxes[:, 3] < self.size_wh[1] - CUT_MARGIN_PX)
