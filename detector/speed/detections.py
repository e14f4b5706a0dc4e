"""Vehicles detected in one frame, in time and on the road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = ["Detections", "inside_larger_box"]


@dataclass(frozen=True, eq=False)
class Detections:
    """N vehicles detected in one frame; made by `detector.speed.view.MeasurementView.place`.

    Args:
        frame: number of the frame.
        time_s: seconds since the first frame; NaN where not known.
        boxes_xyxy: (N, 4) px of the view.
        cc: (N,) in [0, 1]; NaN for variants without it.
        scores: (N,) in [0, 1].
        class_ids: (N,) uint8, `labelgen.labels.VehicleClass`.
        vertices_px: (N, 8, 2) frame px, the 3D boxes in the order of `labelgen.geometry.box_codec`; NaN for 2D
            variants.
        front_edges_px: (N, 2, 2) frame px, both ends of the bottom front edge.
        contact_points_px: (N, 2) frame px, the measured points: middles of the bottom front edges, on the road.
        contact_visible: (N,) False where the lower border of the view cuts off the contact with the road.
        outlines_px: for `fitted3d`: N arrays (K, 2) frame px, points whose convex hull is the outline; else empty.
    """

    frame: int
    time_s: float
    boxes_xyxy: Array
    cc: Array
    scores: Array
    class_ids: NDArray[np.uint8]
    vertices_px: Array
    front_edges_px: Array
    contact_points_px: Array
    contact_visible: NDArray[np.bool_]
    outlines_px: tuple[Array, ...] = ()

    def __len__(self) -> int:
        return len(self.boxes_xyxy)

    def to_dict(self) -> dict[str, Any]:
        """Return the frame's line of a file of detections (`detector.speed.detection_file`), for JSON."""
        line: dict[str, Any] = {
            "frame": self.frame,
            "time_s": _rounded(self.time_s, 6) if np.isfinite(self.time_s) else None,
            "boxes": _rounded(self.boxes_xyxy, 4),
            "scores": _rounded(self.scores, 4),
            "classes": self.class_ids.tolist(),
        }
        if np.isfinite(self.cc).any():
            line["cc"] = _rounded(self.cc, 7)
        if np.isfinite(self.vertices_px).any():
            line["vertices"] = _rounded(self.vertices_px, 4)
        if self.outlines_px:
            line["outlines"] = [_rounded(outline, 2) for outline in self.outlines_px]
        return line


def inside_larger_box(detections: Detections) -> NDArray[np.bool_]:
    """Return (N,) which detections stand on the floor of a larger one, and so are parts of its vehicle.

    A detection is inside where its contact point lies within the bottom face of the 3D box of another detection whose
    2D box is larger. Two vehicles cannot stand on the same place. For variants without 3D boxes all are False.
    """
    floors = detections.vertices_px[:, 4:]
    starts, ends = floors[None], np.roll(floors, -1, axis=1)[None]
    sides, to_point = ends - starts, detections.contact_points_px[:, None, None] - starts
    cross = sides[..., 0] * to_point[..., 1] - sides[..., 1] * to_point[..., 0]
    with np.errstate(invalid="ignore"):
        inside = (cross > 0).all(axis=2) | (cross < 0).all(axis=2)
    areas = (detections.boxes_xyxy[:, 2:] - detections.boxes_xyxy[:, :2]).prod(axis=1)
    return np.asarray((inside & (areas[:, None] < areas[None])).any(axis=1))


def _rounded(values: Any, digits: int) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), digits).tolist()
