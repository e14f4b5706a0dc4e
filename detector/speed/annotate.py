"""The annotated video: 3D boxes, track numbers and speeds drawn into the frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections
from detector.speed.view import MeasurementView
from detector.tracking.iou_tracker import DUPLICATE
from detector.visualize import draw_boxes
from labelgen.drawing import CYAN, GREEN, WHITE, YELLOW, Picture, draw_box3d, draw_polyline, draw_text
from labelgen.errors import LabelgenError
from labelgen.media.frames import Frame
from labelgen.media.video_writer import VideoWriter

__all__ = ["AnnotatedVideo", "annotate", "draw_detections"]

_COLOURS = ((80, 220, 80), (0, 200, 255), (255, 160, 60), (200, 90, 255), (90, 255, 230), (80, 120, 255))
_TRAIL_POINTS = 40


def annotate(
    image: Picture,
    view: MeasurementView,
    detections: Detections,
    ids: NDArray[np.int64],
    speeds_kmh: Mapping[int, float],
    trails: Mapping[int, list[Any]],
) -> None:
    """Draw the detections of a frame into it, in place.

    Args:
        image: (H, W, 3) uint8 BGR, the frame.
        view: of the detections.
        detections: N of them.
        ids: (N,) their tracks; duplicates are not drawn.
        speeds_kmh: speeds so far, by track; a track without speed shows its number only.
        trails: contact points so far, (2,) frame px each, by track.
    """
    thickness = max(1, round(image.shape[1] / 960))
    places: list[tuple[int, int]] = []
    # The nearest vehicle first: where texts would cover each other, those of distant vehicles are left out.
    for i in np.argsort(-detections.contact_points_px[:, 1]).tolist():
        number = int(ids[i])
        if number == DUPLICATE:
            continue
        colour = _COLOURS[number % len(_COLOURS)]
        if len(trails.get(number, ())) > 1:
            draw_polyline(image, trails[number], colour, thickness)
        if np.isfinite(detections.vertices_px[i]).all():
            draw_box3d(image, detections.vertices_px[i], thickness)
            top = detections.vertices_px[i].min(axis=0)
        else:
            corners = view.to_frame(detections.boxes_xyxy[i][[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2))
            draw_polyline(image, corners, GREEN, thickness, closed=True)
            top = corners.min(axis=0)
        edge_colour = YELLOW if detections.contact_visible[i] else CYAN
        draw_polyline(image, detections.front_edges_px[i], edge_colour, thickness + 1)
        if np.isfinite(top).all():
            speed = speeds_kmh.get(number, float("nan"))
            text = f"#{number}" + (f" {speed:.0f} km/h" if np.isfinite(speed) else "")
            _draw_label(image, text, top, places)


def _draw_label(image: Picture, text: str, top: Any, places: list[tuple[int, int]]) -> None:
    """Write a text above a box and note its place, unless it would cover another text."""
    scale = max(0.35, 0.35 * image.shape[1] / 800)
    width, height = round(len(text) * 19 * scale), round(30 * scale)
    x, y = (int(v) for v in np.clip(top, [0, height], [image.shape[1] - width, image.shape[0] - 1]))
    if all(abs(x - u) > width or abs(y - v) > height for u, v in places):
        draw_text(image, text, (x, y - 3), scale, WHITE)
        places.append((x, y))


class AnnotatedVideo:
    """Context manager that writes the annotated video.

    Args:
        path: ends in .avi; such a file can be played even if writing it was interrupted.
        view: of the detections.
        fps: frames per second.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path, view: MeasurementView, fps: float) -> None:
        self._view = view
        width, height = view.frame_wh
        self._even_wh = (width - width % 2, height - height % 2)
        self._writer = VideoWriter(path, fps, self._even_wh)
        self._trails: dict[int, list[Any]] = {}

    def add(
        self, frame: Frame, detections: Detections, ids: NDArray[np.int64], speeds_kmh: Mapping[int, float]
    ) -> None:
        """Annotate and write one more frame.

        Args:
            frame: with its image.
            detections: N of the frame.
            ids: (N,) their tracks.
            speeds_kmh: speeds so far, by track, of all tracks in the frame.

        Raises:
            OutputError: the frame cannot be written.
        """
        # Only the trails of tracks that are in the frame are drawn, so the others are removed.
        for number in [n for n, trail in self._trails.items() if n not in speeds_kmh and len(trail)]:
            del self._trails[number]
        for i, number in enumerate(ids.tolist()):
            if number != DUPLICATE and detections.contact_visible[i]:
                self._trails[number] = [*self._trails.get(number, []), detections.contact_points_px[i]][-_TRAIL_POINTS:]
        image = frame.image[: self._even_wh[1], : self._even_wh[0]].copy()
        annotate(image, self._view, detections, ids, speeds_kmh, self._trails)
        clock = f"{frame.time_s:8.2f} s" if np.isfinite(frame.time_s) else ""
        draw_text(image, f"frame {frame.number} {clock}", (6, image.shape[0] - 8), 0.4)
        self._writer.write(image)

    def __enter__(self) -> AnnotatedVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, value, trace)


def draw_detections(view: MeasurementView, frame: NDArray[np.uint8], detections: Detections) -> Picture:
    """Rectify a frame and draw its detections.

    Args:
        view: of the detections, with a rectification.
        frame: (H, W, 3) uint8 BGR.
        detections: of the frame.

    Returns:
        (h, w, 3) uint8 BGR, the rectified image.

    Raises:
        LabelgenError: the view has no rectification.
    """
    if view.rectification is None:
        raise LabelgenError(f"view: variant {view.variant} rectifies nothing to draw in", parameter="view")
    image = view.rectification.warp_image(frame)
    draw_boxes(image, detections.boxes_xyxy, detections.cc, detections.scores, view.rectification.vpu)
    return image
