"""`labelgen synth`: data sets with exact truth, in the layouts of the real ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.cli.options import (
    APP_SETTINGS,
    DeinterlaceOption,
    Heading,
    JsonOption,
    OverwriteOption,
    check_report_path,
    print_table,
    write_json_report,
)
from labelgen.cli.printing import EndedBySignalError, say
from labelgen.synth.shading.lighting import Weather

__all__ = ["synth_app"]

synth_app = typer.Typer(
    name="synth",
    no_args_is_help=True,
    help="Render traffic with exact truth, in the layouts of the real data sets.",
    **APP_SETTINGS,
)

_Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write; made if missing.")]
_Seed = Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same data.")]


@synth_app.command("boxcars")
def boxcars(
    out: _Out,
    vehicles: Annotated[int, typer.Option("--vehicles", min=1, metavar="N", help="Number of vehicles.")] = 60,
    seed: _Seed = 0,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Write a BoxCars116k tree: crops of vehicles with 3D boxes, seen by several cameras."""
    from labelgen.synth.truth.boxcars116k import write_boxcars_tree

    check_report_path(json_file)
    summary = write_boxcars_tree(out, vehicles, seed, overwrite=overwrite)
    say("synthetic crops in the BoxCars116k layout")
    print_table(list(summary.items()))
    write_json_report(json_file, summary)


@synth_app.command("session")
def session(
    out: _Out,
    duration: Annotated[float, typer.Option("--duration", min=0.04, metavar="S", help="Length in seconds.")] = 20.0,
    fps: Annotated[
        float | None,
        typer.Option("--fps", min=1, max=120, help="Frames per second; 25, or those of --scene's video, by default."),
    ] = None,
    size: Annotated[str, typer.Option("--size", metavar="WxH", help="Frame size; with --scene its picture's.")] = (
        "1920x1080"
    ),
    seed: _Seed = 0,
    scene: Annotated[
        Path | None,
        typer.Option(
            "--scene",
            metavar="PATH",
            help="Where to put the traffic: a real session (ROOT/dataset/NAME), or your own camera's video.",
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration", metavar="FILE", help="Of --scene's video; by default beside it, or made from the video."
        ),
    ] = None,
    road_mask: Annotated[
        Path | None,
        typer.Option(
            "--road-mask", metavar="FILE", help="Of --scene's video; by default beside it, or made from the video."
        ),
    ] = None,
    heading: Annotated[
        Heading | None,
        typer.Option("--heading", case_sensitive=False, help="By default as the video shows, or at random."),
    ] = None,
    sun: Annotated[
        str | None,
        typer.Option(
            "--sun",
            metavar="HEIGHT,RIGHT",
            help="With a video: degrees above the horizon and right of straight ahead; by default from its shadows.",
        ),
    ] = None,
    deinterlace: DeinterlaceOption = False,
    replay: Annotated[bool, typer.Option("--replay", help="Re-enact the scene's recorded traffic.")] = False,
    start: Annotated[
        float | None,
        typer.Option(
            "--start", metavar="S", help="With --replay: where to begin; before the first crossing by default."
        ),
    ] = None,
    weather: Annotated[
        Weather | None, typer.Option("--weather", case_sensitive=False, help="Kind of light; at random by default.")
    ] = None,
    traffic: Annotated[float, typer.Option("--traffic", min=0.1, help="Vehicles per lane and minute.")] = 18.0,
    bodies: Annotated[
        str | None, typer.Option("--bodies", metavar="NAME,...", help="Body types to use; all by default.")
    ] = None,
    plates: Annotated[
        str | None,
        typer.Option("--plates", help="european, yellow, blue or short number plates; all kinds by default."),
    ] = None,
    video: Annotated[bool, typer.Option("--video/--no-video", help="Without: 3D boxes and tracks only.")] = True,
    name: Annotated[
        str | None,
        typer.Option("--name", help="Name of the session; session0_center, or that of --scene, by default."),
    ] = None,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Write a BrnoCompSpeed session: video, road mask, calibration, speeds; and masks, 3D boxes and tracks.

    Ctrl-C ends the recording early: what is written is a shorter session, complete in itself; the exit code is 130.
    Killed in another way it writes nothing.
    """
    from dataclasses import asdict

    from labelgen.choices import parse_size
    from labelgen.synth.truth.session import write_session

    check_report_path(json_file)
    summary = write_session(
        out,
        duration_s=duration,
        fps=fps,
        size_wh=parse_size(size),
        seed=seed,
        name=name,
        weather=weather,
        per_minute=traffic,
        kinds=None if bodies is None else [b.strip() for b in bodies.split(",")],
        plates=plates,
        scene=scene,
        replay=replay,
        start_s=start,
        calibration=calibration,
        road_mask=road_mask,
        heading=None if heading is None else 1 if heading is Heading.AWAY else -1,
        sun=_sun(sun),
        deinterlace=deinterlace,
        video=video,
        overwrite=overwrite,
    )
    report = {**asdict(summary), "complete": summary.complete}
    say(f"synthetic session {summary.name}" + ("" if summary.complete else ", ended early"))
    print_table([*((k, report[k]) for k in ("frames", "vehicles", "masks")), *summary.files.items()])
    if summary.measured:
        say("measured on the video")
        print_table(list(summary.measured.items()))
    write_json_report(json_file, report)
    if not summary.complete:
        raise EndedBySignalError(summary.signal, f"the session has {summary.frames} frames and is whole in itself")


def _sun(text: str | None) -> tuple[float, float] | None:
    from labelgen.errors import LabelgenError

    if text is None:
        return None
    try:
        height, right = (float(part) for part in text.split(","))
    except ValueError:
        height = right = float("nan")
    if not (0 < height <= 90 and -360 <= right <= 360):
        raise LabelgenError(f"--sun {text}: expected HEIGHT,RIGHT in degrees, the height over 0 and up to 90")
    return height, right
