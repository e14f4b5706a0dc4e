"""`labelgen speed`."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from detector.speed.job import SpeedJob, SpeedOptions, job_from_file, job_from_frames
from labelgen.cli.options import (
    CalibrationOption,
    JsonOption,
    OverwriteOption,
    RoadMaskOption,
    SceneSizeOption,
    print_table,
    write_json_report,
)
from labelgen.datasets.brnocompspeed import read_lane_lines

if TYPE_CHECKING:
    from detector.speed.pipeline import SpeedSummary
    from detector.speed.results import ResultFiles

__all__ = ["speed"]


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
    near_end: Annotated[
        str,
        typer.Option(
            "--near-end",
            metavar="WHERE",
            help="Where a mask's vehicle ends: vehicle (as common bodies do) or outline (its lowest line).",
        ),
    ] = "vehicle",
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
    from detector.speed.meter import SpeedMeter
    from detector.speed.pipeline import measure
    from detector.speed.results import ResultFiles

    if from_ is None:
        from_ = "masks:maskrcnn" if variant is not None and variant.strip().lower() == "sochor" else "masks:background"
    chosen = SpeedOptions(
        source, out, calibration, road_mask, from_, variant, pair, size, rule, near_end, score, weights, device, fps,
        duration, stall,
    )  # fmt: skip
    kind, _, argument = from_.partition(":")
    job = (
        job_from_file(chosen, Path(argument), render)
        if kind == "detections"
        else job_from_frames(chosen, kind, argument)
    )
    files = ResultFiles.of(out, job.name, str(job.view.variant))
    files.prepare(overwrite=overwrite)
    lanes, notes = read_lane_lines(source)
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


def _bar(job: SpeedJob) -> AbstractContextManager[Any]:
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


def _close(job: SpeedJob, files: ResultFiles, summary: SpeedSummary, render: bool, json_file: Path | None) -> None:
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
