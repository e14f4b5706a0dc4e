"""From frames to measured vehicles on disk. The way of a frame to a speed:

1. A `DetectionSource` detects its vehicles: 2D boxes with c_c in the rectified image, or 3D boxes around masks.
2. `MeasurementView.place` gives each box its contact point on the road (`variant`, `contact_point`).
3. `IouTracker` joins the boxes of one frame after the other to tracks (Kocur & Ftacnik 2020, section 3.5).
4. `SpeedMeter` takes the points that count and drops tracks that are too short (ibid.).
5. `measure_track` takes the median of the speeds between points i and i + 5 (Sochor et al., IEEE T-ITS 2018).

Frames are read, detected, and tracked and written in three threads that overlap.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from detector.speed.annotate import AnnotatedVideo
from detector.speed.detection_source import DetectionSource
from detector.speed.detections import Detections
from detector.speed.meter import SpeedMeter
from detector.speed.results import ResultFiles, ResultWriter
from detector.speed.track_speed import MeasuredVehicle
from detector.speed.view import MeasurementView
from labelgen.interruption import signal_of
from labelgen.media.frames import Frame
from labelgen.media.prefetch import prefetch
from labelgen.media.timed_frames import TimedFrames

__all__ = ["FrameDetections", "SpeedSummary", "detect", "measure", "with_frames"]

# Frames detected ahead of tracking. A few are enough to overlap both; each one holds an image in memory.
_DETECTIONS_AHEAD = 4

FrameDetections = tuple[Frame | None, Detections]
"""Detections with their frame; None where the frame is not at hand, as for detections from a file."""


@dataclass
class SpeedSummary:
    """Counts and figures of one run.

    Args:
        frames, detections, vehicles: how many there were.
        duplicates: number of boxes that were duplicates, or parts of a larger one.
        without_speed: number of vehicles with too few points for a speed.
        dropped_tracks: number of tracks that were dropped, by reason.
        rejects: number of candidates that gave no detection, by reason.
        speeds_kmh: of all vehicles that have a speed.
        last_s: seconds; time of the last frame.
        seconds: how long the run took.
        signal: number of the signal with which the user ended it; 0 where it ended by itself.
        problems: what was skipped, one line each.
    """

    frames: int = 0
    detections: int = 0
    vehicles: int = 0
    duplicates: int = 0
    without_speed: int = 0
    dropped_tracks: Counter[str] = field(default_factory=Counter)
    rejects: Counter[str] = field(default_factory=Counter)
    speeds_kmh: list[float] = field(default_factory=list)
    last_s: float = 0.0
    seconds: float = 0.0
    signal: int = 0
    problems: list[str] = field(default_factory=list)

    @property
    def interrupted(self) -> bool:
        """Whether the user ended it."""
        return self.signal != 0

    def to_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        median = float(np.median(self.speeds_kmh)) if self.speeds_kmh else None
        return {
            "frames": self.frames,
            "detections": self.detections,
            "duplicates": self.duplicates,
            "vehicles": self.vehicles,
            "vehicles_without_speed": self.without_speed,
            "median_speed_kmh": median,
            "dropped_tracks": dict(self.dropped_tracks),
            "rejects": {reason: count for reason, count in self.rejects.items() if count},
            "video_s": self.last_s,
            "seconds": round(self.seconds, 3),
            "interrupted": self.interrupted,
            "problems": self.problems,
        }


def detect(source: DetectionSource, frames: TimedFrames) -> Iterator[FrameDetections]:
    """Yield frames with their detections; reading and detecting run ahead, each in a thread of its own.

    Args:
        source: detects the vehicles.
        frames: to detect them in.
    """
    return prefetch(source.stream(frames), _DETECTIONS_AHEAD)


def with_frames(lines: Iterable[Detections], frames: TimedFrames | None) -> Iterator[FrameDetections]:
    """Join detections from a file with their frames; frames without detections are left out.

    Args:
        lines: detections, in the order of their frames.
        frames: of the same video; None where frames are not wanted.
    """
    if frames is None:
        for detections in lines:
            yield None, detections
        return
    remaining = frames.frames()
    with closing(remaining):  # type: ignore[type-var]
        frame = next(remaining, None)
        for detections in lines:
            while frame is not None and frame.number < detections.frame:
                frame = next(remaining, None)
            yield (frame if frame is not None and frame.number == detections.frame else None), detections


def measure(
    frame_detections: Iterator[FrameDetections],
    view: MeasurementView,
    meter: SpeedMeter,
    files: ResultFiles,
    *,
    fps: float | None,
    render: bool = False,
    keep_detections: bool = True,
    progress: Callable[[int], object] | None = None,
) -> SpeedSummary:
    """Track, measure and write, until the detections end or the user interrupts.

    Args:
        frame_detections: detections with their frames; frames are needed for `render` only. It is closed at the end.
        view: of the detections.
        meter: a new one.
        files: paths of the results.
        fps: frames per second; None where not known, which is 25 in the annotated video.
        render: whether to write the annotated video.
        keep_detections: whether to write the detections.
        progress: called with the number of frames since its last call.

    Returns:
        the summary of the run. After an interruption all vehicles up to it are written.

    Raises:
        LabelgenError: what the source raises, after all vehicles up to it are written.
        OutputError: a file cannot be written; the vehicles that were finished before are in it.
    """
    summary = SpeedSummary()
    begin = perf_counter()
    with ExitStack() as stack:
        stack.enter_context(closing(frame_detections))  # type: ignore[type-var]
        writer = stack.enter_context(ResultWriter(files, view, fps, keep_detections=keep_detections))
        video = stack.enter_context(AnnotatedVideo(files.video, view, fps or 25.0)) if render else None
        try:
            for frame, detections in frame_detections:
                ids, vehicles = meter.add(detections)
                writer.add_detections(detections)
                _write(writer, vehicles, summary)
                if video is not None and frame is not None:
                    speeds = {number: meter.speed_so_far(number) for number in ids.tolist()}
                    video.add(frame, detections, ids, speeds)
                summary.frames += 1
                summary.detections += len(detections)
                summary.last_s = detections.time_s
                if progress is not None:
                    progress(1)
        except KeyboardInterrupt as err:
            summary.signal = signal_of(err)
        finally:
            # The tracks up to here are complete, whatever ended the frames. If the disk is full, this raises again.
            _write(writer, meter.finish(), summary)
            summary.dropped_tracks, summary.duplicates = meter.dropped, meter.duplicates
            summary.seconds = perf_counter() - begin
    return summary


def _write(writer: ResultWriter, vehicles: list[MeasuredVehicle], summary: SpeedSummary) -> None:
    """Write vehicles and count them in the summary."""
    for vehicle in vehicles:
        writer.add_vehicle(vehicle)
        summary.vehicles += 1
        if np.isfinite(vehicle.speed_kmh):
            summary.speeds_kmh.append(vehicle.speed_kmh)
        else:
            summary.without_speed += 1
