"""`labelgen road-mask`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.cli.options import (
    DeinterlaceOption,
    FpsOption,
    JsonOption,
    OverwriteOption,
    StreamOption,
    check_new_file,
    check_report_path,
    print_table,
    warn_of,
    write_json_report,
)
from labelgen.cli.printing import say

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
    fps: FpsOption = None,
    stream: StreamOption = None,
    deinterlace: DeinterlaceOption = False,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Mark the road in a video: where things move along VP1, as a mask that `labelgen bcs-masks` and `speed` take.

    Refused with the reason, exit code 2, where nothing does.
    """
    from labelgen.calibration.observation.collect import observe
    from labelgen.calibration.pipeline import calibrate_video
    from labelgen.calibration.road_mask import estimate_road_mask, write_mask
    from labelgen.datasets.scene import size_notes
    from labelgen.errors import OutputError
    from labelgen.geometry import Camera
    from labelgen.media.frame_notes import frame_notes
    from labelgen.media.open_frames import open_frames
    from labelgen.staged_output import staged_file

    check_report_path(json_file, out)
    if out.suffix.lower() != ".png":
        raise OutputError(f"--out {out}: name a .png file")
    check_new_file("--out", out, overwrite, [video, calibration])
    frames = open_frames(video, fps=fps, stream=stream, deinterlace=deinterlace)
    with staged_file(out, overwrite=overwrite) as staged:
        with frame_notes(frames):
            if calibration is None:
                estimated = calibrate_video(frames, duration_s=duration)
                camera, observations, doubts = estimated.camera, estimated.observations, list(estimated.doubts)
            else:
                camera = Camera.load(calibration, image_wh=frames.size_wh)
                doubts = list(size_notes(calibration, None, frames.size_wh))
                observations = observe(frames, duration_s=duration)
        road = estimate_road_mask(camera, observations.tracks)
        write_mask(staged, road.pixels)
    rows: list[tuple[str, Any]] = [
        ("of the picture", f"{road.pixels.mean():.0%}"),
        ("tracks along the road", f"{road.tracks}, {road.along:.0%} of all"),
        ("looked at, s", f"{observations.duration_s:.0f}"),
        ("in", out),
    ]
    say(f"Road in {frames.name}")
    print_table(rows)
    warn_of(doubts)
    report = {
        "notes": frames.notes,
        "problems": [*doubts, *frames.problems],
        "share": float(road.pixels.mean()),
        "tracks": road.tracks,
        "along": road.along,
        "out": str(out),
    }
    write_json_report(json_file, {**report, "seconds": observations.duration_s, "calibrated": calibration is None})
