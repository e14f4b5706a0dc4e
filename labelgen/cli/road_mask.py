"""`labelgen road-mask`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.cli.options import JsonOption, OverwriteOption, check_report_path, print_table, write_json_report

__all__ = ["road_mask"]


def road_mask(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="Video of a fixed camera, or a folder of images.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The mask, white where road is, a PNG.")],
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="Camera JSON; without it the video is calibrated as well."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", min=1, metavar="S", help="Look at so many seconds at most.")
    ] = None,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Mark the road in a video: where things move along VP1, as a mask that `labelgen bcs-masks` and `speed` take.

    Refused with the reason, exit code 2, where nothing does.
    """
    from labelgen.calibration.observation.collect import observe
    from labelgen.calibration.pipeline import calibrate_video
    from labelgen.calibration.road_mask import road_mask as estimate
    from labelgen.calibration.road_mask import write_mask
    from labelgen.errors import OutputError
    from labelgen.geometry import Camera
    from labelgen.media.open_frames import open_frames

    check_report_path(json_file, out)
    if out.suffix.lower() != ".png":
        raise OutputError(f"--out {out}: name a .png file")
    if out.is_dir():
        raise OutputError(f"--out {out}: it is a folder; name a file")
    if out.exists() and not overwrite:
        raise OutputError(f"--out {out}: it exists; add --overwrite or choose another name")
    frames = open_frames(video)
    if calibration is None:
        done = calibrate_video(frames, duration_s=duration)
        camera, seen = done.camera, done.seen
    else:
        camera = Camera.load(calibration, image_wh=frames.size_wh)
        seen = observe(frames, duration_s=duration)
    found = estimate(camera, seen.tracks)
    write_mask(out, found.pixels)
    rows: list[tuple[str, Any]] = [
        ("of the picture", f"{found.pixels.mean():.0%}"),
        ("tracks along the road", f"{found.tracks}, {found.along:.0%} of all"),
        ("looked at, s", f"{seen.duration_s:.0f}"),
        ("in", out),
    ]
    typer.echo(f"Road in {frames.name}")
    print_table(rows)
    report = {"share": float(found.pixels.mean()), "tracks": found.tracks, "along": found.along, "out": str(out)}
    write_json_report(json_file, {**report, "seconds": seen.duration_s, "calibrated": calibration is None})
