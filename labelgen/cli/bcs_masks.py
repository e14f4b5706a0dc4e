"""`labelgen bcs-masks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.choices import Pair, Region, Rule
from labelgen.cli.notes import notes_beside
from labelgen.cli.options import (
    CalibrationOption,
    ClassesOption,
    DeinterlaceOption,
    FirstFrameOption,
    FpsOption,
    JsonOption,
    KeyframesOption,
    OverwriteOption,
    PairOption,
    QualityOption,
    RoadMaskOption,
    ScaleMasksOption,
    SceneSizeOption,
    StreamOption,
    TilesOption,
    WorkersOption,
    check_report_path,
    mask_options,
    rectified_size,
    reported,
    show_summary,
)

__all__ = ["bcs_masks"]


def bcs_masks(
    inputs: Annotated[
        list[Path], typer.Argument(metavar="VIDEO_OR_SESSION...", help="Video files, image or session folders.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where the shards go; shards/NAME by default.")
    ] = None,
    calibration: CalibrationOption = None,
    road_mask: RoadMaskOption = None,
    masks: Annotated[
        str,
        typer.Option(
            "--masks",
            metavar="SOURCE",
            help="Where masks come from: maskrcnn, background, coco:FILE, onnx:FILE or gated:onnx:FILE.",
        ),
    ] = "maskrcnn",
    weights: Annotated[
        Path | None, typer.Option("--weights", metavar="FILE", help="Mask R-CNN state dict instead of COCO's weights.")
    ] = None,
    first_frame: FirstFrameOption = None,
    scale_masks: ScaleMasksOption = False,
    classes: ClassesOption = None,
    tiles: TilesOption = None,
    keep_masks: Annotated[
        bool,
        typer.Option(
            "--keep-masks", help="Write the masks beside the shards, as COCO JSON that --masks coco:FILE reads again."
        ),
    ] = False,
    rule: Annotated[
        Rule | None,
        typer.Option(
            "--rule",
            case_sensitive=False,
            help="How masks become labels; fitted by default, wider where the calibration has no scale.",
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(
            "--every", min=1, metavar="N", help="Take every N-th frame; with --keyframes, N or more apart. Default 25."
        ),
    ] = None,
    keyframes: KeyframesOption = False,
    pair: PairOption = Pair.VP2_VP3,
    size: SceneSizeOption = None,
    region: Annotated[
        Region,
        typer.Option(
            "--region",
            case_sensitive=False,
            help="What is rectified: the road; the frame (Previous2D, Previous3D); none (Orig2D).",
        ),
    ] = Region.ROAD,
    limit: Annotated[
        int | None, typer.Option("--limit", min=1, metavar="N", help="Stop after N taken frames of each video.")
    ] = None,
    score: Annotated[float, typer.Option("--score", min=0.0, max=1.0, help="Least score of a mask.")] = 0.5,
    min_height: Annotated[
        float, typer.Option("--min-height", min=1.0, metavar="PX", help="Least height of a label.")
    ] = 10.0,
    device: Annotated[
        str | None, typer.Option("--device", help="Torch device; the GPU when there is one, by default.")
    ] = None,
    fps: FpsOption = None,
    stream: StreamOption = None,
    deinterlace: DeinterlaceOption = False,
    per_shard: Annotated[int, typer.Option("--per-shard", min=1, help="Taken frames in a shard.")] = 500,
    quality: QualityOption = 95,
    workers: WorkersOption = 1,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Label the vehicles of traffic videos through instance masks: rectified frames with 2D boxes and c_c.

    Calibration and road mask are looked for beside each input; where there are none they are made from the video itself
    and kept in the output folder. Every mask becomes a label or is listed with the reason in rejects.jsonl. An
    interrupted run goes on where it stopped when the same command is given again.
    """
    from labelgen.calibration.complete_scene import complete_scene
    from labelgen.datasets.manifest import load_manifest
    from labelgen.datasets.scene import find_scene
    from labelgen.errors import LabelgenError
    from labelgen.jobs.mask_settings import MaskSettings
    from labelgen.jobs.runner import run_job
    from labelgen.jobs.staging import check_output
    from labelgen.jobs.video import video_job
    from labelgen.labeling.from_masks import LabelLimits
    from labelgen.shards.image_codec import ImageCodec

    check_report_path(json_file)
    manifest = load_manifest("brnocompspeed")
    size_wh = rectified_size(size, pair, manifest)
    options = mask_options(first_frame, scale_masks, classes, tiles)
    settings = MaskSettings(
        masks, weights, score, rule, LabelLimits(min_height_px=min_height), device=device, options=options
    )
    # What is wrong with any input is found out before the first one is calibrated.
    scenes = [
        find_scene(
            path,
            calibration=calibration,
            road_mask=road_mask,
            may_lack=True,
            fps=fps,
            stream=stream,
            deinterlace=deinterlace,
        )
        for path in inputs
    ]
    if out is None:
        if len(scenes) > 1:
            raise LabelgenError("several inputs: name the folder for their common shards", parameter="out")
        out = Path("shards") / scenes[0].name
        notes_beside(out)
    check_output(out, overwrite=overwrite)
    single = len(scenes) == 1
    scenes = [
        complete_scene(scene, out if single else out / scene.name, need_scale=False, overwrite=overwrite)
        for scene in scenes
    ]
    with reported(json_file):
        job = video_job(
            scenes,
            pair,
            size_wh,
            settings,
            region=region,
            every=every or manifest["labels"]["every"],
            keyframes=keyframes,
            limit=limit,
            per_shard=per_shard,
            codec=ImageCodec(quality or None),
            keep_masks=keep_masks,
        )
        summary = run_job(job, out, overwrite=overwrite, workers=workers)
    names = ", ".join(scene.name for scene in scenes)
    show_summary(f"Mask labels of {names}, {pair} {size_wh[0]}x{size_wh[1]}", summary, out, json_file)
