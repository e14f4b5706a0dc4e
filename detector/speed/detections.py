"""Vehicles found in one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array

__all__ = ["Detections"]


@dataclass(frozen=True, eq=False)
class Detections:
    """N vehicles found in one frame; made by `detector.speed.measurement.MeasurementView.place`.

    Args:
        frame: its number.
        time_s: seconds since the first frame; NaN where not known.
        boxes_xyxy: (N, 4) px in the view.
        cc: (N,) in [0, 1]; NaN where the variant has none.
        scores: (N,) in [0, 1].
        class_ids: (N,) uint8, `labelgen.labels.VehicleClass`.
        vertices_px: (N, 8, 2) frame px, the 3D boxes in the order of `labelgen.geometry.box_codec`; NaN for 2D
            variants.
        front_edges_px: (N, 2, 2) frame px, both ends of the bottom front edge.
        contact_points_px: (N, 2) frame px, the measured points: the middles of the bottom front edges.
        whole: (N,) False where the view's lower border cuts off the vehicle's foot.
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

    def __len__(self) -> int:
        return len(self.boxes_xyxy)

    def to_dict(self) -> dict[str, Any]:
        """One line of the file."""
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
        return line


def _rounded(values: Any, digits: int) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), digits).tolist()
