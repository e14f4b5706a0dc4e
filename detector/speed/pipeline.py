"""From frames to vehicles on disk. Reading, detecting, and tracking with writing run in three threads that overlap."""

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
from detector.speed.measurement import MeasurementView
from detector.speed.meter import MeasuredVehicle, SpeedMeter
from detector.speed.results import ResultFiles, ResultWriter
from labelgen.media.frames import Frame
from labelgen.media.prefetch import prefetch
from labelgen.media.timed_frames import TimedFrames

__all__ = ["FrameDetections", "SpeedSummary", "detect", "measure", "with_frames"]

_DETECTIONS_AHEAD = 4

FrameDetections = tuple[Frame | None, Detections]


@dataclass
class SpeedSummary:
    """What a run came to.

    Args:
        frames, detections, vehicles, duplicates: counts.
        without_speed: vehicles with too few points for a speed.
        dropped_tracks, rejects: counts by reason.
        speeds_kmh: of all vehicles that have one.
        last_s: time of the last frame.
        seconds: how long it took.
        interrupted: whether somebody stopped it.
        problems: what had to be skipped, one line each.
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
    interrupted: bool = False
    problems: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""
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
    """Frames with their detections; reading and detecting each run ahead in their own thread."""
    return prefetch(source.stream(frames), _DETECTIONS_AHEAD)


def with_frames(lines: Iterable[Detections], frames: TimedFrames | None) -> Iterator[FrameDetections]:
    """Detections read from a file, with their frames beside them where there are any; frames without are left out."""
    if frames is None:
        for found in lines:
            yield None, found
        return
    pictures = frames.frames()
    with closing(pictures):  # type: ignore[type-var]
        frame = next(pictures, None)
        for found in lines:
            while frame is not None and frame.number < found.frame:
                frame = next(pictures, None)
            yield (frame if frame is not None and frame.number == found.frame else None), found


def measure(
    found: Iterator[FrameDetections],
    view: MeasurementView,
    meter: SpeedMeter,
    files: ResultFiles,
    *,
    fps: float | None,
    render: bool = False,
    keep_detections: bool = True,
    progress: Callable[[int], object] | None = None,
) -> SpeedSummary:
    """Track, measure and write, until the detections end or somebody interrupts.

    Args:
        found: detections with, for rendering, their frames.
        view: of the detections.
        meter: new.
        files: where to write.
        fps: frames per second, where known; rendering wants it.
        render: whether to write the annotated video.
        keep_detections: whether to write the detections.
        progress: takes the number of frames done since its last call.

    Raises:
        LabelgenError: what the source raises, after all its vehicles are on disk; or a file cannot be written, after
            which the vehicles that were finished before are in theirs.
    """
    summary = SpeedSummary()
    begin = perf_counter()
    with ExitStack() as stack:
        stack.enter_context(closing(found))  # type: ignore[type-var]
        writer = stack.enter_context(ResultWriter(files, view, fps, keep_detections=keep_detections))
        video = stack.enter_context(AnnotatedVideo(files.video, view, fps or 25.0)) if render else None
        try:
            for frame, detections in found:
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
        except KeyboardInterrupt:
            summary.interrupted = True
        finally:
            # Whatever ended the frames, the tracks up to here are whole. A disk that is full will say so again.
            _write(writer, meter.finish(), summary)
            summary.dropped_tracks, summary.duplicates = meter.dropped, meter.duplicates
            summary.seconds = perf_counter() - begin
    return summary


def _write(writer: ResultWriter, vehicles: list[MeasuredVehicle], summary: SpeedSummary) -> None:
    for vehicle in vehicles:
        writer.add_vehicle(vehicle)
        summary.vehicles += 1
        if np.isfinite(vehicle.speed_kmh):
            summary.speeds_kmh.append(vehicle.speed_kmh)
        else:
            summary.without_speed += 1
