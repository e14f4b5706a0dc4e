"""`labelgen rectify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.cli.options import (
    CalibrationOption,
    JsonOption,
    OverwriteOption,
    PairOption,
    RoadMaskOption,
    SceneSizeOption,
    check_report_path,
    print_table,
    write_json_report,
)

__all__ = ["rectify"]


def rectify(
    source: Annotated[
        Path, typer.Argument(metavar="VIDEO_IMAGE_OR_SESSION", help="Video, image, image folder or session folder.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="PICTURE", help="The rectified picture, PNG or JPEG.")],
    calibration: CalibrationOption = None,
    road_mask: RoadMaskOption = None,
    pair: PairOption = "VP2-VP3",
    size: SceneSizeOption = None,
    cover: Annotated[
        str,
        typer.Option("--cover", metavar="WHAT", help="What fills 80 % of the picture: frame (as published) or mask."),
    ] = "frame",
    frame: Annotated[int, typer.Option("--frame", min=0, metavar="N", help="Frame of a video or image folder.")] = 0,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Rectify one picture of a scene, and give its matrix, VPU and coverage."""
    import cv2

    from labelgen.atomic_files import make_folder, write_atomic
    from labelgen.choices import Pair, parse_size
    from labelgen.datasets.manifest import load_manifest
    from labelgen.datasets.scene import find_scene
    from labelgen.datasets.scene_picture import read_picture
    from labelgen.errors import LabelgenError, OutputError
    from labelgen.geometry.rectification import Rectification

    check_report_path(json_file, out)
    chosen_pair = Pair.parse(pair)
    size_wh = parse_size(size or load_manifest("brnocompspeed")["sizes"][str(chosen_pair)])
    if cover not in ("frame", "mask"):
        raise LabelgenError(f"--cover {cover}: unknown; use frame or mask")
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise OutputError(f"--out {out}: name a .png or .jpg file")
    if out.exists() and not overwrite:
        raise OutputError(f"--out {out}: it exists; add --overwrite or choose another name")
    scene = find_scene(source, calibration=calibration, road_mask=road_mask, need_frames=False)
    image = read_picture(scene, frame)
    camera = scene.camera((image.shape[1], image.shape[0]))
    rectification = Rectification.from_road_mask(
        camera, scene.road(), chosen_pair, size_wh, cover="mask" if cover == "mask" else "frame"
    )
    make_folder(out.parent)
    encoded = cv2.imencode(out.suffix.lower(), rectification.warp_image(image))[1]
    write_atomic(out, encoded.tobytes())
    report = {
        "pair": str(chosen_pair),
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
    typer.echo(f"{scene.name} rectified, {chosen_pair} {size_wh[0]}x{size_wh[1]}")
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
