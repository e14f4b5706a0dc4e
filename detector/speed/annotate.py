"""A video with what was measured drawn into it: 3D boxes, track numbers, speeds so far."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.speed.detections import Detections
from detector.speed.measurement import MeasurementView
from detector.tracking.iou_tracker import DUPLICATE
from detector.visualize import draw_boxes
from labelgen.atomic_files import as_output_error
from labelgen.drawing import CYAN, GREEN, WHITE, YELLOW, Picture, draw_box3d, draw_polyline, draw_text
from labelgen.errors import OutputError
from labelgen.media.frames import Frame
from labelgen.media.video_writer import VideoWriter

__all__ = ["AnnotatedVideo", "annotate", "draw_detections"]

_COLOURS = ((80, 220, 80), (0, 200, 255), (255, 160, 60), (200, 90, 255), (90, 255, 230), (80, 120, 255))
_TRAIL = 40


def annotate(
    image: Picture,
    view: MeasurementView,
    found: Detections,
    ids: NDArray[np.int64],
    speeds_kmh: Mapping[int, float],
    trails: Mapping[int, list[Any]],
) -> None:
    """Draw one frame's detections into it, in place.

    Args:
        image: (H, W, 3) uint8 BGR.
        view: of the detections.
        found: N detections.
        ids: (N,) their tracks.
        speeds_kmh: speed so far, by track; tracks without one show their number alone.
        trails: measured points so far, by track.
    """
    thickness = max(1, round(image.shape[1] / 960))
    places: list[tuple[int, int]] = []
    # The nearest first: where names would cover each other, far vehicles go without.
    for i in np.argsort(-found.contact_points_px[:, 1]).tolist():
        number = int(ids[i])
        if number == DUPLICATE:
            continue
        colour = _COLOURS[number % len(_COLOURS)]
        if len(trails.get(number, ())) > 1:
            draw_polyline(image, trails[number], colour, thickness)
        if np.isfinite(found.vertices_px[i]).all():
            draw_box3d(image, found.vertices_px[i], thickness)
            top = found.vertices_px[i].min(axis=0)
        else:
            corners = view.to_frame(found.boxes_xyxy[i][[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2))
            draw_polyline(image, corners, GREEN, thickness, closed=True)
            top = corners.min(axis=0)
        draw_polyline(image, found.front_edges_px[i], YELLOW if found.contact_visible[i] else CYAN, thickness + 1)
        if np.isfinite(top).all():
            speed = speeds_kmh.get(number, float("nan"))
            text = f"#{number}" + (f" {speed:.0f} km/h" if np.isfinite(speed) else "")
            _name(image, text, top, places)


def _name(image: Picture, text: str, top: Any, places: list[tuple[int, int]]) -> None:
    """Write a name above a box, unless another one is in the way."""
    scale = max(0.35, 0.35 * image.shape[1] / 800)
    width, height = round(len(text) * 19 * scale), round(30 * scale)
    x, y = (int(v) for v in np.clip(top, [0, height], [image.shape[1] - width, image.shape[0] - 1]))
    if all(abs(x - u) > width or abs(y - v) > height for u, v in places):
        draw_text(image, text, (x, y - 3), scale, WHITE)
        places.append((x, y))


class AnnotatedVideo:
    """Context manager that writes the annotated video.

    Args:
        path: ends in .avi; such a file can be played however its writing ended.
        view: of the detections.
        fps: frames per second.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path, view: MeasurementView, fps: float) -> None:
        self.path, self._view = path, view
        width, height = view.frame_wh
        self._even_wh = (width - width % 2, height - height % 2)
        self._writer = VideoWriter(path, fps, self._even_wh)
        self._trails: dict[int, list[Any]] = {}

    def add(self, frame: Frame, found: Detections, ids: NDArray[np.int64], speeds_kmh: Mapping[int, float]) -> None:
        """Write one more frame."""
        # Tracks that are not in the picture for a while have ended or do not show; either way their trail may go.
        for number in [n for n, trail in self._trails.items() if n not in speeds_kmh and len(trail)]:
            del self._trails[number]
        for i, number in enumerate(ids.tolist()):
            if number != DUPLICATE and found.contact_visible[i]:
                self._trails[number] = [*self._trails.get(number, []), found.contact_points_px[i]][-_TRAIL:]
        image = frame.image[: self._even_wh[1], : self._even_wh[0]].copy()
        annotate(image, self._view, found, ids, speeds_kmh, self._trails)
        clock = f"{frame.time_s:8.2f} s" if np.isfinite(frame.time_s) else ""
        draw_text(image, f"frame {frame.number} {clock}", (6, image.shape[0] - 8), 0.4)
        self._guard(self._writer.write, image)

    def _guard(self, work: Any, *arguments: Any) -> None:
        # PyAV's errors are its own; those of the system among them are OSErrors too.
        from av.error import FFmpegError

        try:
            with as_output_error(self.path):
                work(*arguments)
        except FFmpegError as err:
            raise OutputError(f"cannot write {self.path}: {err.strerror or err}") from None

    def __enter__(self) -> AnnotatedVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._guard(self._writer.__exit__, kind, value, trace)
        except OutputError:
            # The first trouble is the one to tell.
            if kind is None:
                raise


def draw_detections(view: MeasurementView, frame: NDArray[np.uint8], found: Detections) -> Picture:
    """A frame, rectified, with its detections."""
    assert view.rectification is not None
    image = view.rectification.warp_image(frame)
    draw_boxes(image, found.boxes_xyxy, found.cc, found.scores, view.rectification.vpu)
    return image
