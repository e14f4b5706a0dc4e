"""`labelgen rectify`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from labelgen.choices import Pair
from labelgen.cli.options import (
    CalibrationOption,
    Cover,
    DeinterlaceOption,
    FpsOption,
    JsonOption,
    OverwriteOption,
    PairOption,
    RoadMaskOption,
    SceneSizeOption,
    StreamOption,
    check_new_file,
    check_report_path,
    picture_suffix,
    print_table,
    rectified_size,
    write_json_report,
)
from labelgen.cli.printing import say

__all__ = ["rectify"]

_log = logging.getLogger(__name__)


def rectify(
    source: Annotated[
        Path, typer.Argument(metavar="VIDEO_IMAGE_OR_SESSION", help="Video, image, image folder or session folder.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="PICTURE", help="The rectified picture, PNG or JPEG.")],
    calibration: CalibrationOption = None,
    road_mask: RoadMaskOption = None,
    pair: PairOption = Pair.VP2_VP3,
    size: SceneSizeOption = None,
    cover: Annotated[
        Cover,
        typer.Option(
            "--cover", case_sensitive=False, help="What fills 80 % of the picture: frame (as published), mask."
        ),
    ] = Cover.FRAME,
    frame: Annotated[int, typer.Option("--frame", min=0, metavar="N", help="Frame of a video or image folder.")] = 0,
    fps: FpsOption = None,
    stream: StreamOption = None,
    deinterlace: DeinterlaceOption = False,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Rectify one picture of a scene, and give its matrix, VPU and coverage."""
    from labelgen.datasets.manifest import load_manifest
    from labelgen.datasets.scene import find_scene
    from labelgen.datasets.scene_picture import read_picture
    from labelgen.geometry.rectification import Rectification
    from labelgen.media.image_file import write_image
    from labelgen.staged_output import staged_file

    check_report_path(json_file, out)
    size_wh = rectified_size(size, pair, load_manifest("brnocompspeed"))
    picture_suffix("--out", out)
    check_new_file("--out", out, overwrite, [source, calibration, road_mask])
    scene = find_scene(
        source,
        calibration=calibration,
        road_mask=road_mask,
        need_frames=False,
        fps=fps,
        stream=stream,
        deinterlace=deinterlace,
    )
    image = read_picture(scene, frame)
    frame_wh = (image.shape[1], image.shape[0])
    camera = scene.camera(frame_wh)
    for note in scene.size_notes(frame_wh):
        _log.warning("%s", note)
    rectification = Rectification.from_road_mask(
        camera, scene.road(frame_wh), pair, size_wh, cover="mask" if cover is Cover.MASK else "frame"
    )
    with staged_file(out, overwrite=overwrite) as staged:
        write_image(staged, rectification.warp_image(image))
    report = {
        "pair": str(pair),
        "size": list(size_wh),
        "matrix": rectification.matrix.tolist(),
        "inverse": rectification.inverse.tolist(),
        "vpu": rectification.vpu.tolist(),
        "frame_coverage": rectification.frame_coverage,
        "road_area": rectification.road_area,
        "crop_steps": rectification.crop_steps,
        "calibration": str(scene.calibration_path),
        "road_mask": str(scene.mask_path),
        "out": str(out),
    }
    write_json_report(json_file, report)
    say(f"{scene.name} rectified, {pair} {size_wh[0]}x{size_wh[1]}")
    print_table(
        [
            ("VPU, px", "{:.1f}, {:.1f}".format(*rectification.vpu)),
            ("frame coverage", f"{rectification.frame_coverage:.3f}"),
            ("road area", f"{rectification.road_area:.3f}"),
            ("crop steps", rectification.crop_steps),
            ("calibration", scene.calibration_path),
            ("road mask", scene.mask_path),
            ("in", out),
        ]
    )
