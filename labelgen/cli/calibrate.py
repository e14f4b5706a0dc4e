"""`labelgen calibrate`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labelgen.cli.notes import notes_beside
from labelgen.cli.options import (
    DeinterlaceOption,
    FpsOption,
    JsonOption,
    OverwriteOption,
    StreamOption,
    check_new_file,
    check_report_path,
    picture_suffix,
    print_table,
    warn_of,
    write_json_report,
)
from labelgen.cli.printing import say

if TYPE_CHECKING:
    from labelgen.calibration.pipeline import Calibration

__all__ = ["calibrate"]


def calibrate(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="Video of a fixed camera, or a folder of images.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The calibration; by default NAME.calibration.json beside VIDEO."),
    ] = None,
    scale: Annotated[
        list[str] | None,
        typer.Option(
            "--scale",
            metavar="WAY",
            help="auto-models (default), auto-dimensions[:L,W,H], or any number of distance:x1,y1,x2,y2,METRES and "
            "lane:x1,y1,x2,y2,METRES.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help="Draw vanishing directions, road grid and tracks, PNG or JPEG."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", min=1, metavar="S", help="Look at so many seconds at most.")
    ] = None,
    pp: Annotated[
        str | None, typer.Option("--pp", metavar="X,Y", help="Principal point, px; by default the picture's middle.")
    ] = None,
    fps: FpsOption = None,
    stream: StreamOption = None,
    deinterlace: DeinterlaceOption = False,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Calibrate a camera from its video alone: vanishing points, focal length and scale, with a confidence.

    A video that cannot carry a calibration is refused with the reason, exit code 2.
    """
    from contextlib import ExitStack

    from labelgen.atomic_files import write_json
    from labelgen.calibration.complete_scene import calibrate_with_scale
    from labelgen.media.frame_notes import frame_notes
    from labelgen.media.open_frames import open_frames
    from labelgen.staged_output import staged_file

    out = out or video.absolute().parent / f"{video.name if video.is_dir() else video.stem}.calibration.json"
    notes_beside(out)
    check_report_path(json_file, out)
    check_new_file("--out", out, overwrite, [video])
    check_new_file("--picture", picture, overwrite, [video, out])
    if picture is not None:
        picture_suffix("--picture", picture)
    principal_point = _point(pp)
    frames = open_frames(video, fps=fps, stream=stream, deinterlace=deinterlace)
    with ExitStack() as stack:
        staged = stack.enter_context(staged_file(out, overwrite=overwrite))
        staged_picture = picture and stack.enter_context(staged_file(picture, overwrite=overwrite))
        with frame_notes(frames):
            calibration = calibrate_with_scale(
                frames, scale or ["auto-models"], need_scale=bool(scale), pp=principal_point, duration_s=duration
            )
        write_json(staged, calibration.to_dict())
        if staged_picture is not None:
            _write_picture(calibration, staged_picture)
    rows = _rows(calibration)
    say(f"{calibration.camera.name} calibrated")
    print_table([*rows, ("in", out), *([("picture", picture)] if picture else [])])
    warn_of(calibration.doubts)
    report = {
        **calibration.to_dict(),
        "focal": calibration.camera.focal,
        "vp3": calibration.camera.vp3.tolist(),
        "out": str(out),
        "notes": frames.notes,
        "problems": frames.problems,
    }
    write_json_report(json_file, {**report, "picture": str(picture) if picture else None})


def _point(text: str | None) -> list[float] | None:
    from labelgen.errors import LabelgenError

    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise LabelgenError(f"--pp {text}: expected two numbers X,Y in px") from None
    return [x, y]


def _rows(calibration: Calibration) -> list[tuple[str, Any]]:
    camera, evidence = calibration.camera, calibration.orientation.evidence
    confidence = calibration.confidence()
    points = [(f"VP{k}, px", "{:.1f}, {:.1f}".format(*camera.vanishing_point(k))) for k in (1, 2, 3)]
    points[0] = (points[0][0], f"{points[0][1]}  (known to {evidence.vp1_sd_deg:.2f} degrees)")
    rows: list[tuple[str, Any]] = [
        *points,
        ("focal length, px", f"{camera.focal:.0f}  (known to {evidence.focal_sd:.1%})"),
        ("vehicles", evidence.vehicles),
        ("tracks along the road", f"{evidence.along_share:.0%} of {evidence.tracks}"),
        ("edges across it", f"{evidence.vp2_edges:.0f} of {evidence.edges}"),
        ("looked at, s", f"{evidence.duration_s:.0f}" + ("" if calibration.observations.ended else " (enough)")),
        ("confidence", f"{confidence['overall']:.2f}"),
    ]
    if calibration.scale is not None:
        known = f", known to {calibration.scale.spread:.1%}" if math.isfinite(calibration.scale.spread) else ""
        rows.insert(4, ("scale", f"{calibration.scale.scale:.6g}  ({calibration.scale.method}{known})"))
    return rows


def _write_picture(calibration: Calibration, path: Path) -> None:
    import numpy as np

    from labelgen.calibration.plot import draw_calibration
    from labelgen.media.image_file import write_image

    observations = calibration.observations
    image = np.zeros((observations.size_wh[1], observations.size_wh[0], 3), np.uint8)
    if observations.background is not None:
        image = np.ascontiguousarray(observations.background[..., ::-1])
    tracks = [observations.tracks[k] for k in calibration.orientation.supporting.tolist()]
    text = [f"{calibration.camera.name}: confidence {calibration.confidence()['overall']:.2f}", *calibration.doubts]
    drawn = draw_calibration(image, calibration.camera, tracks, text)
    write_image(path, drawn)
