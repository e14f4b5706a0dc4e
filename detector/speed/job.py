"""What is measured: from an opened scene and settings to a view, frames and an iterator of detections."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from detector.speed.contact_point import MaskExtent
from detector.speed.detection_file import DetectionFile
from detector.speed.detection_source import DetectionSource
from detector.speed.detections import Detections
from detector.speed.mask_detections import MaskDetections, MaskPlacer
from detector.speed.meter import SpeedMeter
from detector.speed.model_detections import DetectorDetections, model_view
from detector.speed.pipeline import FrameDetections, detect, with_frames
from detector.speed.track_fit import TrackFitter
from detector.speed.variant import Variant
from detector.speed.view import MeasurementView
from labelgen.before_torch import check_device, check_torch_file
from labelgen.datasets.scene import Scene, SceneFiles, read_lane_lines
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Pair, Rule
from labelgen.geometry.homography import Array
from labelgen.masks import (
    MASK_OPTIONS,
    Clip,
    MaskKind,
    MaskOptions,
    MaskSource,
    check_masks,
    check_masks_file,
    create_mask_source,
    parse_masks,
    prime_masks,
)
from labelgen.masks.background.source import BackgroundMasks
from labelgen.masks.gated import GatedMasks
from labelgen.media.frames import Frame, FrameSource
from labelgen.media.timed_frames import TimedFrames

if TYPE_CHECKING:
    from detector.inference import Detector

__all__ = ["MaskSpeedSettings", "SpeedJob", "job_from_file", "job_from_masks", "job_from_model"]

_WARM_UP_S = 10.0
_WARM_UP_SHARE = 0.2


@dataclass(frozen=True)
class MaskSpeedSettings:
    """How speeds are measured on instance masks.

    Args:
        masks: name of a mask source, see `labelgen.masks.parse_masks`.
        variant: how the measured point of a vehicle is found.
        pair: vanishing points of the rectification.
        size_wh: of the rectified image, px.
        rule: how the two candidates of c_c become one.
        correct_contact_point: whether points measured on outlines are moved to where the vehicle touches the road.
        score: least score of a mask.
        weights: state dict of Mask R-CNN instead of COCO's.
        device: torch device; None for the GPU when there is one.
        options: of the mask source, where it takes any.

    Raises:
        LabelgenError: the variant does not go with these masks.
    """

    masks: str
    variant: Variant = Variant.TRANSFORM3D
    pair: Pair = Pair.VP2_VP3
    size_wh: tuple[int, int] = (640, 360)
    rule: Rule = Rule.WIDER
    correct_contact_point: bool = True
    score: float = 0.5
    weights: Path | None = None
    device: str | None = None
    options: MaskOptions = MASK_OPTIONS

    def __post_init__(self) -> None:
        check_masks_file(self.masks)
        check_device(self.device)
        if self.weights is not None:
            check_torch_file(self.weights, f"weights {self.weights}", parameter="weights")
        if not self.rule.is_of_tangents:
            raise LabelgenError(
                f"rule {self.rule}: it needs whole passages; choose another, or measure them with variant fitted3d",
                parameter="rule",
            )
        if self.variant is Variant.FITTED3D and not self.correct_contact_point:
            raise LabelgenError(
                "variant fitted3d: its measured point is that of a body, where the outline ends does not matter; leave "
                "the contact point as it is",
                parameter="correct_contact_point",
            )
        if self.variant is Variant.DUBSKA and not self.from_background:
            raise LabelgenError(
                "variant dubska: its vehicles are all that moves, so it takes background masks only; use maskrcnn3d "
                "for masks of another kind",
                parameter="variant",
            )
        if self.variant is Variant.SOCHOR and self.from_background:
            raise LabelgenError(
                "variant sochor: detections must say which silhouettes are vehicles; use masks of maskrcnn, "
                "coco:FILE or onnx:FILE",
                parameter="variant",
            )

    @property
    def from_background(self) -> bool:
        """Whether the masks are a background model's."""
        return parse_masks(self.masks).kind is MaskKind.BACKGROUND

    @property
    def mask_extent(self) -> MaskExtent | None:
        """What the masks cover; None to leave measured points uncorrected."""
        if not self.correct_contact_point:
            return None
        # The masks of `sochor` come from a background model, too.
        shaded = parse_masks(self.masks).is_shaded or self.variant is Variant.SOCHOR
        return MaskExtent.BODY_AND_SHADE if shaded else MaskExtent.BODY


@dataclass(frozen=True)
class SpeedJob:
    """A view, an iterator of detections, and what can be told afterwards.

    Args:
        name: of the results.
        view: where the detections lie.
        fps: frames per second, where known.
        frames: what is decoded; None where nothing is.
        source: where detections come from; None for a file of them.
        detections: starts the work: an iterator over frames with their detections.
        frame_count: how many frames are to be expected, where known.
        lane_lines: (L, 3) homogeneous lines in frame px between which the lanes lie, where known.
        notes: what could not be read, one line each.
    """

    name: str
    view: MeasurementView
    fps: float | None
    frames: FrameSource | None
    source: DetectionSource | None
    detections: Callable[[], Iterator[FrameDetections]]
    frame_count: int | None
    lane_lines: Array | None = None
    notes: tuple[str, ...] = ()

    def problems(self) -> list[str]:
        """Return what had to be skipped, one line each."""
        frames = [*self.frames.notes, *self.frames.problems] if self.frames is not None else []
        source = self.source.problems if self.source is not None else []
        return [*self.notes, *frames, *source]

    def meter(self) -> SpeedMeter:
        """Return what measures the detections."""
        fitter = TrackFitter(self.view) if self.view.variant is Variant.FITTED3D else None
        return SpeedMeter(self.view.camera, fps=self.fps, lane_lines=self.lane_lines, fitter=fitter)

    @property
    def failure(self) -> Exception | None:
        """Why a stream broke off, if it did."""
        return self.frames.failure if self.frames is not None else None


def job_from_masks(scene: Scene, settings: MaskSpeedSettings, *, duration_s: float | None = None) -> SpeedJob:
    """Plan to measure on instance masks.

    Args:
        scene: opened.
        settings: of the masks and the measured points.
        duration_s: measure so many seconds at most.

    Raises:
        LabelgenError: unknown mask source, or a setting that it does not have.
        DataError: weights or masks that cannot be used.
        RectificationError: the scene admits no such rectification.
    """
    frames, road = scene.frames, scene.road
    view = MeasurementView.create(
        settings.variant, scene.camera, road, settings.pair, settings.size_wh, mask_extent=settings.mask_extent
    )
    masks: MaskSource = create_mask_source(
        settings.masks,
        weights=settings.weights,
        score_threshold=settings.score,
        road_mask=road.pixels,
        device=settings.device,
        frame_wh=frames.size_wh,
        clip=Clip.of(frames),
        camera=scene.camera,
        options=settings.options,
    )
    check_masks(masks)
    if settings.variant is Variant.SOCHOR and not parse_masks(settings.masks).is_gated:
        masks = GatedMasks(masks, BackgroundMasks(road_mask=road.pixels))
    source = MaskDetections(masks, MaskPlacer(view, road, settings.pair, settings.rule))
    timed = _timed(scene, masks, duration_s)

    def detections() -> Iterator[FrameDetections]:
        if not frames.is_live:
            prime_masks(masks, frames)
        return detect(source, timed)

    return _job(scene, view, timed, source, detections)


def job_from_model(
    scene: Scene, detector: Detector, variant: Variant | None = None, *, duration_s: float | None = None
) -> SpeedJob:
    """Plan to measure on the boxes of a trained detector.

    Args:
        scene: opened.
        detector: sees pictures rectified as it was trained on.
        variant: see `detector.speed.model_detections.model_view`.
        duration_s: measure so many seconds at most.

    Raises:
        LabelgenError: the variant does not go with the detector.
        RectificationError: the scene admits no rectification as the detector needs it.
    """
    source = DetectorDetections(detector, model_view(detector.metadata, scene.camera, scene.road, variant))
    timed = TimedFrames(scene.frames, fps=scene.frames.fps or scene.fps, duration_s=duration_s)
    return _job(scene, source.view, timed, source, lambda: detect(source, timed))


def job_from_file(
    file: DetectionFile,
    scene: SceneFiles,
    *,
    with_pictures: bool = False,
    fps: float | None = None,
    duration_s: float | None = None,
) -> SpeedJob:
    """Plan to measure on detections that are kept in a file.

    Args:
        file: of the detections; it says how they were made.
        scene: their scene, for its camera and lanes.
        with_pictures: whether frames are to come with the detections, for an annotated video.
        fps: frames per second where the file states none.
        duration_s: measure so many seconds at most.

    Raises:
        DataError: the calibration or the video cannot be read.
    """
    view = file.view(scene.camera(file.frame_wh))
    fps = file.fps or fps or scene.fps
    timed = replace(file, fps=fps)
    pictures = with_pictures and scene.frames_path is not None
    frames = TimedFrames(scene.open_frames(), fps=fps) if pictures and scene.frames_path else None
    lane_lines, notes = read_lane_lines(scene)
    notes = (*scene.size_notes(file.frame_wh), *notes)

    def detections() -> Iterator[FrameDetections]:
        lines = _with_times(timed.frames(view), file.path)
        kept = lines if duration_s is None else takewhile(lambda line: not line.time_s >= duration_s, lines)
        return with_frames(kept, frames)

    return SpeedJob(scene.name, view, fps, frames, None, detections, None, lane_lines, notes)


def _with_times(lines: Iterator[Detections], path: Path) -> Iterator[Detections]:
    for line in lines:
        if not math.isfinite(line.time_s):
            raise DataError(
                f"{path}: frame {line.frame} has no time, so there are no speeds; give fps", parameter="fps"
            )
        yield line


def _job(
    scene: Scene,
    view: MeasurementView,
    timed: TimedFrames,
    source: DetectionSource,
    detections: Callable[[], Iterator[FrameDetections]],
) -> SpeedJob:
    return SpeedJob(
        scene.name, view, timed.fps, scene.frames, source, detections, timed.frame_count, scene.lane_lines, scene.notes
    )


def _timed(scene: Scene, masks: MaskSource, duration_s: float | None) -> TimedFrames:
    """Return the frames to measure. Of a stream, the mask source may learn from the first seconds."""
    frames, fps = scene.frames, scene.frames.fps or scene.fps
    if not (frames.is_live and masks.prime_frames):
        return TimedFrames(frames, fps=fps, duration_s=duration_s)
    warm_up = _WARM_UP_S if duration_s is None else min(_WARM_UP_S, _WARM_UP_SHARE * duration_s)

    def learn(coming: Iterator[Frame]) -> None:
        masks.prime(frame.image for frame in takewhile(lambda frame: frame.time_s < warm_up, coming))

    return TimedFrames(frames, fps=fps, duration_s=duration_s, lead_in=learn)
