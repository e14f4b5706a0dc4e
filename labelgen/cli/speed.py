"""`labelgen speed`."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from detector.speed.variant import Variant
from labelgen.before_torch import check_device, check_torch_file
from labelgen.choices import Pair, Rule
from labelgen.cli.options import (
    CalibrationOption,
    ClassesOption,
    ContactPoint,
    DeinterlaceOption,
    FirstFrameOption,
    FpsOption,
    JsonOption,
    OverwriteOption,
    RoadMaskOption,
    RuleOption,
    ScaleMasksOption,
    SceneSizeOption,
    StreamOption,
    TilesOption,
    check_report_path,
    mask_options,
    print_table,
    rectified_size,
    reported,
    warn_of,
    write_json_report,
)
from labelgen.cli.printing import EndedBySignalError, say
from labelgen.errors import LabelgenError, NoVehiclesError
from labelgen.progress import progress_bar

if TYPE_CHECKING:
    from detector.speed.job import SpeedJob
    from detector.speed.pipeline import SpeedSummary
    from detector.speed.results import ResultFiles
    from labelgen.datasets.scene import Scene
    from labelgen.masks.mask_options import MaskOptions
    from labelgen.staged_output import StagedOutput

__all__ = ["speed"]

_log = logging.getLogger(__name__)


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
            "masks:coco:FILE, masks:onnx:FILE, masks:gated:onnx:FILE, model:FILE or detections:FILE.",
        ),
    ] = None,
    variant: Annotated[
        Variant | None,
        typer.Option("--variant", case_sensitive=False, help="How points are measured; transform3d by default."),
    ] = None,
    pair: Annotated[
        Pair | None,
        typer.Option(
            "--pair",
            case_sensitive=False,
            metavar="VP2-VP3|VP1-VP2",
            help="VP2-VP3 by default, or as the model needs it.",
        ),
    ] = None,
    size: SceneSizeOption = None,
    rule: RuleOption = Rule.WIDER,
    near_end: Annotated[
        ContactPoint,
        typer.Option(
            "--near-end",
            case_sensitive=False,
            help="Where a mask's vehicle ends: vehicle (as common bodies do) or outline (its lowest line).",
        ),
    ] = ContactPoint.VEHICLE,
    score: Annotated[float, typer.Option("--score", min=0.0, max=1.0, help="Least score of a mask.")] = 0.5,
    weights: Annotated[
        Path | None, typer.Option("--weights", metavar="FILE", help="Mask R-CNN state dict instead of COCO's weights.")
    ] = None,
    first_frame: FirstFrameOption = None,
    scale_masks: ScaleMasksOption = False,
    classes: ClassesOption = None,
    tiles: TilesOption = None,
    device: Annotated[
        str | None, typer.Option("--device", help="Torch device; the GPU when there is one, by default.")
    ] = None,
    fps: FpsOption = None,
    stream: StreamOption = None,
    deinterlace: DeinterlaceOption = False,
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
    vehicle, and the detections, each as it comes: whatever happens, the vehicles that have passed are on disk. They
    grow in DIR/NAME/.labelgen-speed-VARIANT and move up when the video ends.
    """
    from contextlib import ExitStack

    from detector.speed.results import ResultFiles

    check_report_path(json_file)
    if from_ is None:
        from_ = "masks:maskrcnn" if variant is Variant.SOCHOR else "masks:background"
    inputs = _Inputs(
        source,
        out,
        calibration,
        road_mask,
        fps,
        stream,
        deinterlace,
        duration,
        stall,
        variant is Variant.DUBSKA,
        overwrite,
    )
    kind, _, argument = from_.partition(":")
    with ExitStack() as stack:
        with reported(json_file):
            if kind == "masks" and argument:
                plan = _plan_masks(
                    inputs, argument, variant or Variant.TRANSFORM3D, pair or Pair.VP2_VP3, size, rule, near_end, score,
                    weights, device, mask_options(first_frame, scale_masks, classes, tiles),
                )  # fmt: skip
            elif kind == "model" and argument:
                plan = _plan_model(inputs, Path(argument), variant, pair, size, score, device)
            elif kind == "detections" and argument:
                plan = _plan_file(inputs, Path(argument), variant, pair, size, render)
            else:
                raise LabelgenError(
                    f"from_ {from_}: unknown; use masks:background, masks:maskrcnn, masks:coco:FILE, masks:onnx:FILE, "
                    "model:FILE or detections:FILE",
                    parameter="from_",
                )
            files = ResultFiles.of(out, inputs.name, str(plan.variant))
            output = stack.enter_context(files.staged(overwrite=overwrite, needs_overwrite=inputs.is_stream))
            job = plan.open_job()
        _measure(job, output, files, render, keep_detections=kind != "detections", json_file=json_file)


def _measure(
    job: SpeedJob, output: StagedOutput, files: ResultFiles, render: bool, *, keep_detections: bool,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Measure, move the results up if they are whole, and tell what they are."""
    from detector.speed.pipeline import measure
    from labelgen.errors import OutputError

    staged = files.within(output.path, str(job.view.variant))
    meter = job.meter()
    is_live = job.frames is not None and job.frames.is_live
    with progress_bar(job.frame_count, "frame", job.name) as advance:
        try:
            summary = measure(
                job.detections(), job.view, meter, staged, fps=job.fps, render=render, progress=advance,
                keep_detections=keep_detections,
            )  # fmt: skip
        except Exception as err:
            if is_live and not isinstance(err, OutputError):
                output.publish()
            for problem in job.problems():
                _log.warning("%s", problem)
            _say_what_is_there(files if output.published else staged)
            raise
    # A stream ends whenever it ends; what is measured of it cannot be measured again.
    if is_live or not summary.interrupted:
        output.publish()
    if job.source is not None:
        summary.rejects.update(job.source.rejects)
    summary.problems += [*meter.problems(), *job.problems()]
    _close(job, files if output.published else staged, summary, render, json_file)


class _Inputs(NamedTuple):
    """What says where frames, calibration and road come from."""

    source: str
    out: Path
    calibration: Path | None
    road_mask: Path | None
    fps: float | None
    stream: int | None
    deinterlace: bool
    duration_s: float | None
    stall_s: float
    scale_from_dimensions: bool
    overwrite: bool

    @property
    def is_stream(self) -> bool:
        """Whether the frames come from a live camera."""
        from labelgen.media.stream import is_stream_url

        return is_stream_url(self.source)

    @property
    def name(self) -> str:
        """Name of the results."""
        from labelgen.datasets.scene import input_name
        from labelgen.media.stream import stream_name

        return stream_name(self.source) if self.is_stream else input_name(Path(self.source))

    def open(self) -> Scene:
        """Open the scene; where a calibration or road mask is missing, make it from the video."""
        from labelgen.calibration.complete_scene import complete_scene
        from labelgen.datasets.scene import find_scene, open_stream

        if self.is_stream:
            return open_stream(
                self.source, calibration=self.calibration, road_mask=self.road_mask, duration_s=self.duration_s,
                stall_s=self.stall_s, fps=self.fps, stream=self.stream, deinterlace=self.deinterlace,
            )  # fmt: skip
        files = find_scene(
            Path(self.source), calibration=self.calibration, road_mask=self.road_mask, may_lack=True, fps=self.fps,
            stream=self.stream, deinterlace=self.deinterlace,
        )  # fmt: skip
        files.check_times()
        # Each system with the scale it was published with; models are what serves everything else best.
        scale = "auto-dimensions" if self.scale_from_dimensions else "auto-models"
        scene = complete_scene(files, self.out / self.name, scale=scale, overwrite=self.overwrite)
        return replace(scene.open(), name=self.name)


class _Plan(NamedTuple):
    """What is known before anything is opened: the variant, and how the job is opened."""

    variant: Variant
    open_job: Callable[[], SpeedJob]


def _plan_masks(
    inputs: _Inputs, masks: str, variant: Variant, pair: Pair, size: str | None, rule: Rule, near_end: ContactPoint,
    score: float, weights: Path | None, device: str | None, options: MaskOptions,
) -> _Plan:  # fmt: skip
    from detector.speed.job import MaskSpeedSettings, job_from_masks
    from labelgen.datasets.manifest import load_manifest

    settings = MaskSpeedSettings(
        masks, variant, pair, rectified_size(size, pair, load_manifest("brnocompspeed")), rule,
        near_end is ContactPoint.VEHICLE, score, weights, device, options,
    )  # fmt: skip
    return _Plan(variant, lambda: job_from_masks(inputs.open(), settings, duration_s=inputs.duration_s))


def _plan_model(
    inputs: _Inputs, checkpoint: Path, variant: Variant | None, pair: Pair | None, size: str | None, score: float,
    device: str | None,
) -> _Plan:  # fmt: skip
    check_torch_file(checkpoint, f"checkpoint {checkpoint}", parameter="from_")
    check_device(device)
    from detector.inference import load_detector
    from detector.speed.job import job_from_model
    from detector.speed.model_detections import model_variant
    from labelgen.choices import parse_size

    detector = load_detector(checkpoint, score=score, device=device)
    own = detector.metadata
    if (pair or own.pair) != own.pair or (size and parse_size(size) != own.size_wh):
        raise LabelgenError(
            f"{checkpoint}: this detector sees {own.pair} pictures of {own.size_wh[0]}x{own.size_wh[1]}; leave out "
            "--pair and --size, or use a checkpoint trained for them"
        )
    chosen = model_variant(own, variant)
    return _Plan(chosen, lambda: job_from_model(inputs.open(), detector, chosen, duration_s=inputs.duration_s))


def _plan_file(
    inputs: _Inputs, path: Path, variant: Variant | None, pair: Pair | None, size: str | None, render: bool
) -> _Plan:
    from detector.speed.detection_file import DetectionFile
    from detector.speed.job import job_from_file
    from labelgen.datasets.scene import find_scene

    file = DetectionFile.open(path)
    if variant is Variant.FITTED3D:
        file, variant = file.fitted(), None
    for option, value in (("--variant", variant), ("--pair", pair), ("--size", size)):
        if value:
            raise LabelgenError(f"--from detections:{path}: the file itself says how it was made; leave out {option}")
    scene = find_scene(
        Path(inputs.source),
        calibration=inputs.calibration,
        road_mask=inputs.road_mask,
        need_frames=render,
        fps=inputs.fps,
        stream=inputs.stream,
        deinterlace=inputs.deinterlace,
    )

    def open_job() -> SpeedJob:
        job = job_from_file(file, scene, with_pictures=render, fps=inputs.fps, duration_s=inputs.duration_s)
        return replace(job, name=inputs.name)

    return _Plan(file.variant, open_job)


def _say_what_is_there(files: ResultFiles) -> None:
    """Log, after an error, how many vehicles are on disk."""
    if files.vehicles.is_file():
        count = max(0, files.vehicles.read_bytes().count(b"\n") - 1)
        _log.warning("%d finished vehicles are in %s", count, files.tracks.parent)


def _close(job: SpeedJob, files: ResultFiles, summary: SpeedSummary, render: bool, json_file: Path | None) -> None:
    """Print the closing table, write --json, and raise why a stream broke off."""
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
    say(f"Speeds of {job.name}, {job.view.variant}" + (f", {pair}" if pair else ""))
    print_table(rows)
    warn_of(summary.problems)
    written = {"tracks": files.tracks, "vehicles": files.vehicles, "detections": files.detections}
    if render:
        written["video"] = files.video
    failure = job.failure
    none_found = _no_vehicles(job, summary)
    write_json_report(
        json_file,
        {
            "name": job.name,
            "variant": str(job.view.variant),
            **report,
            "failure": None if failure is None else str(failure),
            **({} if none_found is None else {"error": str(none_found)}),
            "files": {name: str(path) for name, path in written.items() if path.is_file()},
        },
    )
    if failure is not None:
        _say_what_is_there(files)
        raise failure
    if summary.interrupted:
        raise EndedBySignalError(
            summary.signal, f"{summary.vehicles} vehicles up to there are in {files.tracks.parent}"
        )
    if none_found is not None:
        raise none_found


def _no_vehicles(job: SpeedJob, summary: SpeedSummary) -> NoVehiclesError | None:
    """Return why a run found no vehicle; None where it found one."""
    if summary.vehicles:
        return None
    reasons = [
        *(f"{count} x {reason}" for reason, count in summary.rejects.most_common() if count),
        *(f"{count} x track dropped, {reason}" for reason, count in summary.dropped_tracks.most_common() if count),
        *summary.problems[:3],
    ]
    return NoVehiclesError(
        f"no vehicles found in {job.name}: {summary.detections} detections in {summary.frames} frames"
        + (f" ({'; '.join(reasons)})" if reasons else "")
    )
