"""`labelgen synth`: data sets with exact truth, in the layouts of the real ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = ["synth_app"]

synth_app = typer.Typer(
    name="synth", no_args_is_help=True, help="Render traffic with exact truth, in the layouts of the real data sets."
)

_Out = Annotated[Path, typer.Option("--out", help="Folder to write; made if missing.")]
_Seed = Annotated[int, typer.Option("--seed", help="The same seed gives the same data.")]
_Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
_Json = Annotated[Path | None, typer.Option("--json", help="Write the closing summary to this file, too.")]


def _close(summary: dict[str, Any], json_file: Path | None) -> None:
    for key, value in summary.items():
        typer.echo(f"{key}: {value}")
    if json_file is not None:
        json_file.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")


@synth_app.command("boxcars")
def boxcars(
    out: _Out,
    vehicles: Annotated[int, typer.Option("--vehicles", min=1, help="Number of vehicles (tracks).")] = 60,
    seed: _Seed = 0,
    overwrite: _Overwrite = False,
    json_file: _Json = None,
) -> None:
    """Write a BoxCars116k tree: crops of vehicles with 3D boxes, seen by several cameras."""
    from labelgen.synth.boxcars_tree import write_boxcars_tree

    summary = write_boxcars_tree(out, vehicles, seed, overwrite=overwrite, progress=True)
    _close(summary, json_file)


@synth_app.command("session")
def session(
    out: _Out,
    duration: Annotated[float, typer.Option("--duration", min=0.04, help="Length in seconds.")] = 20.0,
    fps: Annotated[float, typer.Option("--fps", min=1, max=120, help="Frames per second.")] = 25.0,
    size: Annotated[str, typer.Option("--size", help="Frame size, WIDTHxHEIGHT.")] = "1920x1080",
    seed: _Seed = 0,
    scene: Annotated[
        Path | None, typer.Option("--scene", help="Folder of a real session (ROOT/dataset/NAME) to put traffic into.")
    ] = None,
    replay: Annotated[bool, typer.Option("--replay", help="Re-enact the scene's recorded traffic.")] = False,
    start: Annotated[
        float | None, typer.Option("--start", help="With --replay: second of the recording to begin at.")
    ] = None,
    weather: Annotated[str | None, typer.Option("--weather", help="day, overcast, dusk or rain.")] = None,
    traffic: Annotated[float, typer.Option("--traffic", min=0.1, help="Vehicles per lane and minute.")] = 18.0,
    video: Annotated[bool, typer.Option("--video/--no-video", help="Without: boxes and tracks only.")] = True,
    name: Annotated[str, typer.Option("--name", help="Name of the session, without --scene.")] = "session0_center",
    overwrite: _Overwrite = False,
    json_file: _Json = None,
) -> None:
    """Write a BrnoCompSpeed session: video, road mask, calibration, speeds; and masks, 3D boxes and tracks."""
    from dataclasses import asdict

    from labelgen.geometry import parse_size
    from labelgen.synth.light import Weather
    from labelgen.synth.session import write_session

    summary = write_session(
        out, duration_s=duration, fps=fps, size_wh=parse_size(size), seed=seed, name=name,
        weather=None if weather is None else Weather.parse(weather), per_minute=traffic, scene=scene, replay=replay,
        start_s=start, video=video, overwrite=overwrite, progress=True,
    )  # fmt: skip
    _close(asdict(summary), json_file)
    if not summary.complete:
        raise typer.Exit(130)
