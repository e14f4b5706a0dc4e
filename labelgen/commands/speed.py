"""`labelgen speed`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labelgen.commands.common import (
    CalibrationOption,
    JsonOption,
    OverwriteOption,
    RoadMaskOption,
    SceneSizeOption,
    note,
    print_table,
    write_json_report,
)

if TYPE_CHECKING:
    from detector.pipeline import Found, SpeedSummary
    from detector.results import ResultFiles
    from detector.sources import DetectionSource
    from detector.timed_frames import TimedFrames
    from detector.variants import View
    from labelgen.geometry import Camera, RoadMask
    from labelgen.geometry.projective import Array
    from labelgen.masks import MaskSource
    from labelgen.sources.frames import Frame, FrameSource

__all__ = ["speed"]

_WARM_UP_S = 10.0
_WARM_UP_SHARE = 0.2


def speed(
    source: Annotated[
        str, typer.Argument(metavar="VIDEO_OR_SESSION", help="Video, image or session folder, or a camera's URL.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Results go to DIR/NAME, NAME being the input's.")],
    calibration: CalibrationOption = None,
    road_mask: RoadMaskOption = None,
    from_: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="SOURCE",
            help="Where vehicles come from: masks:background (default), masks:maskrcnn (default of sochor), "
            "masks:coco:FILE, model:FILE or detections:FILE.",
        ),
    ] = None,
    variant: Annotated[
        str | None,
        typer.Option(
            "--variant",
            metavar="NAME",
            help="transform3d (default), transform2d, orig2d, maskrcnn3d, previous3d, previous2d, dubska or sochor.",
        ),
    ] = None,
    pair: Annotated[str | None, typer.Option("--pair", metavar="PAIR", help="VP2-VP3 (default) or VP1-VP2.")] = None,
    size: SceneSizeOption = None,
    rule: Annotated[
        str, typer.Option("--rule", metavar="RULE", help="How c_c's two candidates become one: wider or conditioned.")
    ] = "wider",
    score: Annotated[float, typer.Option("--score", min=0.0, max=1.0, help="Least score of a mask.")] = 0.5,
    weights: Annotated[
        Path | None, typer.Option("--weights", metavar="FILE", help="Mask R-CNN state dict instead of COCO's weights.")
    ] = None,
    device: Annotated[
        str | None, typer.Option("--device", help="Torch device; the GPU when there is one, by default.")
    ] = None,
    fps: Annotated[
        float | None, typer.Option("--fps", min=0.001, help="Frame rate of frames without time stamps, as images.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", min=0.001, metavar="S", help="Stop after S seconds of the video.")
    ] = None,
    stall: Annotated[
        float,
        typer.Option("--stall", min=0.1, metavar="S", help="A stream that sends nothing for S seconds is given up."),
    ] = 10.0,
    render: Annotated[
        bool, typer.Option("--render", help="Write a video with 3D boxes, track numbers, speeds.")
    ] = False,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Measure the speed of every vehicle that passes: tracks, speeds, sizes, lanes, directions.

    Where there is no calibration or road mask they are made from the video itself and kept with the results.

    Writes tracks in the public result format (`labelgen evaluate --results DIR` reads them), a CSV with one row per
    vehicle, and the detections, each as it comes: whatever happens, the vehicles that have passed are on disk.
    """
    from detector.pipeline import measure
    from detector.results import ResultFiles
    from detector.speed import SpeedMeter

    if from_ is None:
        from_ = "masks:maskrcnn" if variant is not None and variant.strip().lower() == "sochor" else "masks:background"
    chosen = _Options(
        source, out, calibration, road_mask, from_, variant, pair, size, rule, score, weights, device, fps, duration,
        stall,
    )  # fmt: skip
    kind, _, argument = from_.partition(":")
    job = _from_file(chosen, Path(argument), render) if kind == "detections" else _from_frames(chosen, kind, argument)
    files = ResultFiles.of(out, job.name, str(job.view.variant))
    files.prepare(overwrite=overwrite)
    lanes, notes = _lane_lines(source)
    meter = SpeedMeter(job.view.camera, fps=job.fps, lane_lines=lanes)
    with _bar(job) as bar:
        try:
            summary = measure(
                job.found(), job.view, meter, files, fps=job.fps, render=render, progress=bar,
                keep_detections=kind != "detections",
            )  # fmt: skip
        except Exception:
            bar.close()
            _say_what_is_there(files)
            raise
    if job.detector is not None:
        summary.rejects.update(job.detector.rejects)
    summary.problems += [*notes, *job.problems()]
    _close(job, files, summary, render, json_file)


@dataclass(frozen=True)
class _Options:
    source: str
    out: Path
    calibration: Path | None
    road_mask: Path | None
    from_: str
    variant: str | None
    pair: str | None
    size: str | None
    rule: str
    score: float
    weights: Path | None
    device: str | None
    fps: float | None
    duration: float | None
    stall: float


@dataclass(frozen=True)
class _Job:
    """What is measured: a view, an iterator of detections, and what can be told afterwards."""

    name: str
    view: View
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


def _from_frames(options: _Options, kind: str, argument: str) -> _Job:
    from detector.mask_detections import MaskDetections, MaskPlacer
    from detector.pipeline import detect
    from detector.variants import Variant, View
    from labelgen.errors import LabelgenError
    from labelgen.geometry import Pair, Rule, parse_size
    from labelgen.manifest import load_manifest
    from labelgen.masks import create_mask_source, prime_masks
    from labelgen.masks.background import BackgroundMasks
    from labelgen.masks.confirmed import ConfirmedMasks

    if kind == "model" and argument:
        return _from_model(options, Path(argument))
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
    size_wh = parse_size(options.size or load_manifest("brnocompspeed")["sizes"][str(pair)])
    is_url = _is_url(options)
    frames, camera, road, rate = _open(options)
    view = View.create(chosen, camera, road, pair, size_wh)
    masks: MaskSource = create_mask_source(
        argument, weights=options.weights, score_threshold=options.score, road_mask=road.pixels,
        device=options.device, frame_wh=frames.size_wh,
    )  # fmt: skip
    if chosen is Variant.SOCHOR:
        masks = ConfirmedMasks(masks, BackgroundMasks(road_mask=road.pixels))
    detector = MaskDetections(masks, MaskPlacer(view, road, pair, rule))
    timed = _timed(frames, masks, frames.fps or rate, options.duration)

    def found() -> Iterator[Found]:
        if not is_url:
            prime_masks(masks, frames)
        return detect(detector, timed)

    return _Job(
        frames.name if is_url else _name(options.source), view, timed.fps, frames, detector, found, timed.frame_count
    )


def _from_model(options: _Options, checkpoint: Path) -> _Job:
    from detector.infer import Detector, model_view
    from detector.pipeline import detect
    from detector.sources import DetectorDetections
    from detector.timed_frames import TimedFrames
    from detector.variants import Variant
    from labelgen.errors import LabelgenError
    from labelgen.geometry import Pair, parse_size

    model = Detector.load(checkpoint, score=options.score, device=options.device)
    card = model.card
    asked = (options.pair and Pair.parse(options.pair), options.size and parse_size(options.size))
    if any(given and given != own for given, own in zip(asked, (card.pair, card.size_wh), strict=True)):
        raise LabelgenError(
            f"--from {options.from_}: it sees {card.pair} pictures of {card.size_wh[0]}x{card.size_wh[1]}; leave out "
            "--pair and --size, or use a checkpoint trained for them"
        )
    frames, camera, road, rate = _open(options)
    variant = Variant.parse(options.variant) if options.variant else None
    detections = DetectorDetections(model, model_view(card, camera, road, variant))
    timed = TimedFrames(frames, fps=frames.fps or rate, duration_s=options.duration)
    name = frames.name if _is_url(options) else _name(options.source)
    return _Job(
        name, detections.view, timed.fps, frames, detections, lambda: detect(detections, timed), timed.frame_count
    )


def _is_url(options: _Options) -> bool:
    from labelgen.sources.stream import is_stream

    return is_stream(options.source)


def _name(source: str) -> str:
    path = Path(source)
    return path.resolve().name if path.is_dir() else path.stem


def _open(options: _Options) -> tuple[FrameSource, Camera, RoadMask, float | None]:
    """The frames with their camera, road mask, and the frame rate stated for them."""
    from labelgen.calibrate.automatic import complete_scene
    from labelgen.errors import DataError
    from labelgen.geometry import Camera, RoadMask
    from labelgen.sources.frames import open_frames
    from labelgen.sources.scenes import read_mask
    from labelgen.sources.stream import VideoStream

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
        lambda name: options.out / _name(options.source),
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
    from detector.timed_frames import TimedFrames
    from labelgen.sources.stream import VideoStream

    if not (isinstance(frames, VideoStream) and masks.prime_frames):
        return TimedFrames(frames, fps=fps, duration_s=duration)
    warm_up = _WARM_UP_S if duration is None else min(_WARM_UP_S, _WARM_UP_SHARE * duration)

    def learn(coming: Iterator[Frame]) -> None:
        masks.prime(frame.image for frame in takewhile(lambda frame: frame.time_s < warm_up, coming))

    return TimedFrames(frames, fps=fps, duration_s=duration, lead_in=learn)


def _from_file(options: _Options, path: Path, render: bool) -> _Job:
    from detector.detection_file import DetectionFile
    from detector.pipeline import with_frames
    from detector.timed_frames import TimedFrames
    from labelgen.errors import LabelgenError
    from labelgen.sources.frames import open_frames
    from labelgen.sources.scenes import find_scene

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

    def found() -> Iterator[Found]:
        lines = file.frames(view)
        kept = lines if duration is None else takewhile(lambda line: not line.time_s >= duration, lines)
        return with_frames(kept, frames)

    return _Job(_name(options.source), view, fps, frames, None, found, None)


def _lane_lines(source: str) -> tuple[Array | None, list[str]]:
    """The lane lines of a session, and what is wrong with its ground truth, if anything is."""
    from detector.score.groundtruth import read_ground_truth
    from labelgen.errors import DataError
    from labelgen.manifest import load_manifest

    path = Path(source)
    folder = path if path.is_dir() else path.parent
    truth = folder / load_manifest("brnocompspeed")["layout"]["ground_truth"]
    if "://" in source or not truth.is_file():
        return None, []
    try:
        return read_ground_truth(truth).lane_lines, []
    except DataError as err:
        return None, [f"lanes are not known: {err}"]


def _bar(job: _Job) -> AbstractContextManager[Any]:
    import sys

    from tqdm import tqdm

    interval = 0.1 if sys.stderr.isatty() else 10.0  # a log file wants a line now and then
    bar: AbstractContextManager[Any] = tqdm(total=job.expected, desc=job.name, unit="frame", mininterval=interval)
    return bar


def _say_what_is_there(files: ResultFiles) -> None:
    """After an error: how many vehicles are on disk."""
    if files.vehicles.is_file():
        count = max(0, files.vehicles.read_bytes().count(b"\n") - 1)
        typer.echo(f"note: {count} finished vehicles are in {files.tracks.parent}", err=True)


def _close(job: _Job, files: ResultFiles, summary: SpeedSummary, render: bool, json_file: Path | None) -> None:
    """Print the closing table, write --json, and tell why a stream broke off."""
    report = summary.to_dict()
    rows: list[tuple[str, Any]] = [
        ("frames", summary.frames),
        ("detections", summary.detections),
        *((f"  rejected: {reason}", count) for reason, count in report["rejects"].items()),
        ("vehicles", summary.vehicles),
        *((f"  tracks dropped: {reason}", count) for reason, count in summary.dropped_tracks.items()),
        ("median speed, km/h", "-" if report["median_speed_kmh"] is None else f"{report['median_speed_kmh']:.1f}"),
        ("seconds, of video", f"{summary.seconds:.1f} for {summary.last_s:.1f}"),
        ("in", files.tracks.parent),
    ]
    pair = job.view.rectification and job.view.rectification.pair
    typer.echo(f"Speeds of {job.name}, {job.view.variant}" + (f", {pair}" if pair else ""))
    print_table(rows)
    for problem in summary.problems:
        typer.echo(f"note: {problem}", err=True)
    written = {"tracks": files.tracks, "vehicles": files.vehicles, "detections": files.detections}
    if render:
        written["video"] = files.video
    failure = job.failure
    write_json_report(
        json_file,
        {
            "name": job.name,
            "variant": str(job.view.variant),
            **report,
            "failure": None if failure is None else str(failure),
            "files": {name: str(path) for name, path in written.items() if path.is_file()},
        },
    )
    if failure is not None:
        _say_what_is_there(files)
        raise failure
    if summary.interrupted:
        raise KeyboardInterrupt
