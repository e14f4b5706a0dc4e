"""What `labelgen speed` measures: from its options to a view, frames and an iterator of detections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labelgen.cli.options import note

if TYPE_CHECKING:
    from detector.speed.detection_source import DetectionSource
    from detector.speed.measurement import MeasurementView
    from detector.speed.pipeline import FrameDetections
    from labelgen.geometry import Camera, RoadMask
    from labelgen.masks import MaskSource
    from labelgen.media.frames import Frame, FrameSource
    from labelgen.media.timed_frames import TimedFrames

__all__ = ["SpeedJob", "SpeedOptions", "job_from_file", "job_from_frames", "source_name"]

_WARM_UP_S = 10.0
_WARM_UP_SHARE = 0.2


@dataclass(frozen=True)
class SpeedOptions:
    source: str
    out: Path
    calibration: Path | None
    road_mask: Path | None
    from_: str
    variant: str | None
    pair: str | None
    size: str | None
    rule: str
    near_end: str
    score: float
    weights: Path | None
    device: str | None
    fps: float | None
    duration: float | None
    stall: float


@dataclass(frozen=True)
class SpeedJob:
    """What is measured: a view, an iterator of detections, and what can be told afterwards."""

    name: str
    view: MeasurementView
    fps: float | None
    frames: FrameSource | None
    detector: DetectionSource | None
    found: Any
    expected: int | None

    def problems(self) -> list[str]:
        """What frames and detector had to skip."""
        return [*(self.frames.problems if self.frames else []), *(self.detector.problems if self.detector else [])]

    @property
    def failure(self) -> Exception | None:
        """Why a stream broke off, if it did."""
        return getattr(self.frames, "failure", None)


def job_from_frames(options: SpeedOptions, kind: str, argument: str) -> SpeedJob:
    from detector.speed.contact_point import MaskExtent
    from detector.speed.mask_detections import MaskDetections, MaskPlacer
    from detector.speed.measurement import MeasurementView, Variant
    from detector.speed.pipeline import detect
    from labelgen.datasets.manifest import load_manifest
    from labelgen.errors import LabelgenError
    from labelgen.geometry import Pair, Rule, parse_size
    from labelgen.masks import create_mask_source, prime_masks
    from labelgen.masks.background.source import BackgroundMasks
    from labelgen.masks.gated import GatedMasks

    if kind == "model" and argument:
        return _job_from_model(options, Path(argument))
    if kind != "masks" or not argument:
        raise LabelgenError(
            f"--from {options.from_}: unknown; use masks:background, masks:maskrcnn, masks:coco:FILE, model:FILE or "
            "detections:FILE"
        )
    chosen, pair = Variant.parse(options.variant or "transform3d"), Pair.parse(options.pair or "VP2-VP3")
    if chosen is Variant.DUBSKA and argument != "background":
        raise LabelgenError("--variant dubska: its vehicles are all that moves; leave out --from, or use maskrcnn3d")
    if chosen is Variant.SOCHOR and argument == "background":
        raise LabelgenError(
            "--variant sochor: detections must say which blobs are vehicles; use --from masks:maskrcnn or "
            "masks:coco:FILE"
        )
    rule = Rule.parse(options.rule)
    if options.near_end not in ("vehicle", "outline"):
        raise LabelgenError(f"--near-end {options.near_end}: use vehicle or outline")
    size_wh = parse_size(options.size or load_manifest("brnocompspeed")["sizes"][str(pair)])
    is_url = _is_url(options)
    frames, camera, road, rate = _open(options)
    mask_extent = None
    if options.near_end == "vehicle":
        # The outlines of `sochor` are a background model's, too.
        shaded = argument == "background" or chosen is Variant.SOCHOR
        mask_extent = MaskExtent.BODY_AND_SHADE if shaded else MaskExtent.BODY
    view = MeasurementView.create(chosen, camera, road, pair, size_wh, mask_extent=mask_extent)
    masks: MaskSource = create_mask_source(
        argument, weights=options.weights, score_threshold=options.score, road_mask=road.pixels,
        device=options.device, frame_wh=frames.size_wh,
    )  # fmt: skip
    if chosen is Variant.SOCHOR:
        masks = GatedMasks(masks, BackgroundMasks(road_mask=road.pixels))
    detector = MaskDetections(masks, MaskPlacer(view, road, pair, rule))
    timed = _timed(frames, masks, frames.fps or rate, options.duration)

    def found() -> Iterator[FrameDetections]:
        if not is_url:
            prime_masks(masks, frames)
        return detect(detector, timed)

    return SpeedJob(
        frames.name if is_url else source_name(options.source),
        view,
        timed.fps,
        frames,
        detector,
        found,
        timed.frame_count,
    )


def _job_from_model(options: SpeedOptions, checkpoint: Path) -> SpeedJob:
    from detector.inference import load_detector
    from detector.speed.measurement import Variant
    from detector.speed.model_detections import DetectorDetections, model_view
    from detector.speed.pipeline import detect
    from labelgen.errors import LabelgenError
    from labelgen.geometry import Pair, parse_size
    from labelgen.media.timed_frames import TimedFrames

    model = load_detector(checkpoint, score=options.score, device=options.device)
    metadata = model.metadata
    asked = (options.pair and Pair.parse(options.pair), options.size and parse_size(options.size))
    if any(given and given != own for given, own in zip(asked, (metadata.pair, metadata.size_wh), strict=True)):
        raise LabelgenError(
            f"--from {options.from_}: it sees {metadata.pair} pictures of "
            f"{metadata.size_wh[0]}x{metadata.size_wh[1]}; leave out --pair and --size, or use a checkpoint trained "
            "for them"
        )
    frames, camera, road, rate = _open(options)
    variant = Variant.parse(options.variant) if options.variant else None
    detections = DetectorDetections(model, model_view(metadata, camera, road, variant))
    timed = TimedFrames(frames, fps=frames.fps or rate, duration_s=options.duration)
    name = frames.name if _is_url(options) else source_name(options.source)
    return SpeedJob(
        name, detections.view, timed.fps, frames, detections, lambda: detect(detections, timed), timed.frame_count
    )


def _is_url(options: SpeedOptions) -> bool:
    from labelgen.media.stream import is_stream_url

    return is_stream_url(options.source)


def source_name(source: str) -> str:
    path = Path(source)
    return path.resolve().name if path.is_dir() else path.stem


def _open(options: SpeedOptions) -> tuple[FrameSource, Camera, RoadMask, float | None]:
    """The frames with their camera, road mask, and the frame rate stated for them."""
    from labelgen.calibration.complete_scene import complete_scene
    from labelgen.datasets.scene import read_mask
    from labelgen.errors import DataError
    from labelgen.geometry import Camera, RoadMask
    from labelgen.media.open_frames import open_frames
    from labelgen.media.stream import VideoStream

    if _is_url(options):
        if options.calibration is None or options.road_mask is None:
            raise DataError(f"{options.source}: a stream needs --calibration FILE and --road-mask FILE")
        road = RoadMask(read_mask(options.road_mask))
        # What can be wrong on this side is found out before the camera is bothered.
        Camera.load(options.calibration, image_wh=road.size_wh)
        stream = VideoStream(options.source, duration_s=options.duration, stall_s=options.stall)
        return stream, Camera.load(options.calibration, image_wh=stream.size_wh), road, options.fps
    scene = complete_scene(
        Path(options.source),
        lambda name: options.out / source_name(options.source),
        note,
        calibration=options.calibration,
        road_mask_file=options.road_mask,
        # Each system with the scale it was published with; models are what serves everything else best.
        scale="auto-dimensions" if (options.variant or "").strip().lower() == "dubska" else "auto-models",
    )
    assert scene.frames_path is not None
    frames = open_frames(scene.frames_path)
    return frames, scene.camera(frames.size_wh), scene.road(), options.fps or scene.fps


def _timed(frames: FrameSource, masks: MaskSource, fps: float | None, duration: float | None) -> TimedFrames:
    """The frames to measure. Of a stream, the first seconds are only learnt from where the mask source wants to."""
    from labelgen.media.stream import VideoStream
    from labelgen.media.timed_frames import TimedFrames

    if not (isinstance(frames, VideoStream) and masks.prime_frames):
        return TimedFrames(frames, fps=fps, duration_s=duration)
    warm_up = _WARM_UP_S if duration is None else min(_WARM_UP_S, _WARM_UP_SHARE * duration)

    def learn(coming: Iterator[Frame]) -> None:
        masks.prime(frame.image for frame in takewhile(lambda frame: frame.time_s < warm_up, coming))

    return TimedFrames(frames, fps=fps, duration_s=duration, lead_in=learn)


def job_from_file(options: SpeedOptions, path: Path, render: bool) -> SpeedJob:
    from detector.speed.detection_file import DetectionFile
    from detector.speed.pipeline import with_frames
    from labelgen.datasets.scene import find_scene
    from labelgen.errors import LabelgenError
    from labelgen.media.open_frames import open_frames
    from labelgen.media.timed_frames import TimedFrames

    file = DetectionFile.open(path)
    asked = [name for name in ("variant", "pair", "size") if getattr(options, name)]
    if asked:
        raise LabelgenError(f"--from {options.from_}: the file itself says how it was made; leave out --{asked[0]}")
    scene = find_scene(
        Path(options.source), calibration=options.calibration, road_mask=options.road_mask, need_frames=render
    )
    view = file.view(scene.camera(file.frame_wh))
    fps = file.fps or options.fps or scene.fps
    frames = TimedFrames(open_frames(scene.frames_path), fps=fps) if render and scene.frames_path is not None else None
    duration = options.duration

    def found() -> Iterator[FrameDetections]:
        lines = file.frames(view)
        kept = lines if duration is None else takewhile(lambda line: not line.time_s >= duration, lines)
        return with_frames(kept, frames)

    return SpeedJob(source_name(options.source), view, fps, frames, None, found, None)
