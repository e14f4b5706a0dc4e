"""The image in which the boxes of a variant lie, and the way of a box from it to the road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.speed.contact_point import MaskExtent, move_to_contact_point
from detector.speed.detections import Detections
from detector.speed.variant import Variant
from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, Pair, Rectification, RoadMask, decode_boxes
from labelgen.geometry.boxes import CUT_MARGIN_PX
from labelgen.geometry.homography import Array

__all__ = ["MeasurementView"]


@dataclass(frozen=True, eq=False)
class MeasurementView:
    """The image in which the boxes of a variant lie and are tracked, with its mapping to the frame and the road.

    Args:
        variant: how the measured point is found.
        camera: with a scale and the size of its frame.
        rectification: of the frame; None where boxes lie in the frame.
        mask_extent: what the masks cover, for boxes that end with the outline of a mask. Measured points are then
            moved to the contact point (`detector.speed.contact_point`), except those of `orig2d` and `fitted3d`. None
            for boxes that end at the edge of a 3D box on the road.

    Raises:
        CalibrationError: the camera has no scale, or does not know the size of its frame.
    """

    variant: Variant
    camera: Camera
    rectification: Rectification | None
    mask_extent: MaskExtent | None = None

    def __post_init__(self) -> None:
        if self.camera.image_wh is None:
            raise CalibrationError(f"camera {self.camera.name or '(unnamed)'}: its frame's size is not known")
        # The height is in metres: this raises where there is no scale.
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
        """Rectify the scene as the variant needs it.

        Args:
            variant: how the measured point is found; decides what is rectified.
            camera: with a scale and the size of its frame.
            road: mask of the road in the frame.
            pair: of the rectification.
            size_wh: px; of the rectified image.
            mask_extent: as for the class.

        Raises:
            CalibrationError: the camera has no scale, or does not know the size of its frame.
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
        """Size of the image in which the boxes lie, px."""
        return self.frame_wh if self.rectification is None else self.rectification.size_wh

    def to_frame(self, points: ArrayLike) -> Array:
        """Map points (..., 2) from px of the view to px of the frame."""
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
        outlines_px: Sequence[Array] | None = None,
    ) -> tuple[Detections, NDArray[np.bool_]]:
        """Place the boxes of a frame in time and on the road.

        Args:
            frame: number of the frame.
            time_s: seconds since the first frame.
            boxes_xyxy: (N, 4) px of the view.
            cc: (N,) for variants that decode it.
            scores: (N,) in [0, 1]; 1 where left out.
            class_ids: (N,) `labelgen.labels.VehicleClass`; 0 where left out.
            vertices_px: (N, 8, 2) frame px, the 3D boxes of variants that build them around outlines.
            outlines_px: for `fitted3d`: N arrays (K, 2) frame px, points whose convex hull is the outline; the corners
                of the 3D boxes where left out.

        Returns:
            the valid detections; and valid (N,), False where a box has no area, no 3D box fits into it, or its contact
            point is not finite.
        """
        boxes = np.asarray(boxes_xyxy, dtype=np.float64).reshape(-1, 4)
        n = len(boxes)
        score_of = np.ones(n) if scores is None else np.asarray(scores, dtype=np.float64)
        classes = np.zeros(n, dtype=np.uint8) if class_ids is None else np.asarray(class_ids, dtype=np.uint8)
        cc_of, vertices, edges = self._boxes_3d(boxes, cc, vertices_px)
        points = self._middles(edges)
        if self.mask_extent is not None and self.variant not in (Variant.ORIG2D, Variant.FITTED3D):
            points = move_to_contact_point(self.camera, points, self.mask_extent)
        has_area = np.isfinite(boxes).all(axis=1) & (boxes[:, :2] < boxes[:, 2:]).all(axis=1)
        valid = np.asarray(has_area & np.isfinite(edges).all(axis=(1, 2)) & np.isfinite(points).all(axis=1))
        detections = Detections(
            frame,
            time_s,
            boxes_xyxy=boxes[valid],
            cc=cc_of[valid],
            scores=score_of[valid],
            class_ids=classes[valid],
            vertices_px=vertices[valid],
            front_edges_px=self.to_frame(edges[valid]),
            contact_points_px=points[valid],
            contact_visible=self._contact_visible(boxes[valid]),
            outlines_px=self._outlines(vertices, outlines_px, valid),
        )
        return detections, valid

    def _outlines(
        self, vertices: Array, outlines_px: Sequence[Array] | None, valid: NDArray[np.bool_]
    ) -> tuple[Array, ...]:
        if self.variant is not Variant.FITTED3D:
            return ()
        points = [cv2.convexHull(p.astype(np.float32))[:, 0] for p in outlines_px] if outlines_px else vertices
        return tuple(np.asarray(points[i], dtype=np.float32) for i in np.flatnonzero(valid).tolist())

    def _boxes_3d(self, boxes: Array, cc: Any, vertices_px: Any) -> tuple[Array, Array, Array]:
        """Return c_c (N,), 3D boxes (N, 8, 2) frame px, bottom front edges (N, 2, 2) px of the view; NaN for none."""
        n = len(boxes)
        no_cc, no_vertices = np.full(n, np.nan), np.full((n, 8, 2), np.nan)
        if not self.variant.is_3d:
            return no_cc, no_vertices, boxes[:, [0, 3, 2, 3]].reshape(-1, 2, 2)
        if self.rectification is None:
            vertices = (
                no_vertices if vertices_px is None else np.asarray(vertices_px, dtype=np.float64).reshape(-1, 8, 2)
            )
            return no_cc, vertices, vertices[:, 4:6]
        cc_of = no_cc if cc is None else np.asarray(cc, dtype=np.float64).reshape(-1)
        decoded, valid = decode_boxes(boxes, cc_of, self.rectification.vpu)
        decoded[~valid] = np.nan
        return cc_of, self.to_frame(decoded), decoded[:, 4:6]

    def _middles(self, edges: Array) -> Array:
        """Return (N, 2) frame px of the middles of edges (N, 2, 2) in px of the view."""
        if self.variant.is_3d and self.rectification is None:
            # In the frame the edge is seen in perspective, so its middle is taken on the road.
            return self.camera.project(self.camera.road_points(edges, invalid="nan").mean(axis=1))
        return self.to_frame(edges.mean(axis=1))

    def _contact_visible(self, boxes: Array) -> NDArray[np.bool_]:
        """Return (N,) False where the lower border of the view cuts the box, which then does not end on the road."""
        if self.rectification is None:
            return np.ones(len(boxes), dtype=np.bool_)
        return np.asarray(boxes[:, 3] < self.size_wh[1] - CUT_MARGIN_PX)
