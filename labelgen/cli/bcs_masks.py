"""`labelgen bcs-masks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.cli.options import (
    CalibrationOption,
    JsonOption,
    OverwriteOption,
    PairOption,
    QualityOption,
    RoadMaskOption,
    SceneSizeOption,
    WorkersOption,
    check_report_path,
    note,
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
        typer.Option("--masks", metavar="SOURCE", help="Where masks come from: maskrcnn, background or coco:FILE."),
    ] = "maskrcnn",
    weights: Annotated[
        Path | None, typer.Option("--weights", metavar="FILE", help="Mask R-CNN state dict instead of COCO's weights.")
    ] = None,
    rule: Annotated[
        str, typer.Option("--rule", metavar="RULE", help="How c_c's two candidates become one: wider or conditioned.")
    ] = "wider",
    every: Annotated[
        int | None,
        typer.Option("--every", min=1, metavar="N", help="Take every N-th frame; 25 by default."),
    ] = None,
    pair: PairOption = "VP2-VP3",
    size: SceneSizeOption = None,
    region: Annotated[
        str,
        typer.Option(
            "--region", metavar="NAME", help="What is rectified: road; frame (Previous2D, Previous3D); none (Orig2D)."
        ),
    ] = "road",
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
    from labelgen.choices import Pair, Region, Rule, parse_size
    from labelgen.datasets.manifest import load_manifest
    from labelgen.datasets.scene import find_scene_parts
    from labelgen.errors import LabelgenError
    from labelgen.jobs.runner import run_job
    from labelgen.jobs.video import MaskSettings, video_job
    from labelgen.labeling.from_masks import LabelLimits
    from labelgen.shards.image_codec import ImageCodec

    check_report_path(json_file)
    chosen_pair = Pair.parse(pair)
    manifest = load_manifest("brnocompspeed")
    size_wh = parse_size(size or manifest["sizes"][str(chosen_pair)])
    # What is wrong with any input is found out before the first one is calibrated.
    names = [find_scene_parts(path, calibration=calibration, road_mask=road_mask)[0].name for path in inputs]
    if out is None:
        if len(names) > 1:
            raise LabelgenError("several inputs: name the folder for their common shards with --out DIR")
        out = Path("shards") / names[0]
    beside = out
    scenes = [
        complete_scene(
            path, lambda name: beside if len(inputs) == 1 else beside / name, note,
            calibration=calibration, road_mask_file=road_mask, need_scale=False,
        )
        for path in inputs
    ]  # fmt: skip
    settings = MaskSettings(
        masks, weights, score, Rule.parse(rule), LabelLimits(min_height_px=min_height), device=device
    )
    job = video_job(
        scenes,
        chosen_pair,
        size_wh,
        settings,
        region=Region.parse(region),
        every=every or manifest["labels"]["every"],
        limit=limit,
        per_shard=per_shard,
        codec=ImageCodec(quality or None),
    )
    summary = run_job(job, out, overwrite=overwrite, workers=workers)
    show_summary(f"Mask labels of {', '.join(names)}, {chosen_pair} {size_wh[0]}x{size_wh[1]}", summary, out, json_file)
