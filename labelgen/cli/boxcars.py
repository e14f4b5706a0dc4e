"""`labelgen boxcars`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.choices import Pair
from labelgen.cli.options import (
    JsonOption,
    OverwriteOption,
    PairOption,
    QualityOption,
    WorkersOption,
    check_report_path,
    rectified_size,
    reported,
    show_summary,
)

__all__ = ["boxcars"]


def boxcars(
    root: Annotated[
        Path | None,
        typer.Option("--root", metavar="DIR", help="Folder of BoxCars116k; otherwise $LABELGEN_BOXCARS116K."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the shards go.")] = Path(
        "shards/boxcars116k"
    ),
    pair: PairOption = Pair.VP2_VP3,
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="WxH", help="Size of the rectified crops; 320x180, or 180x320 for VP1-VP2."),
    ] = None,
    cameras: Annotated[
        str,
        typer.Option("--cameras", metavar="NAMES", help="paper (without the four unreliable ones), all, or NAME,NAME."),
    ] = "paper",
    to_camera_only: Annotated[
        bool, typer.Option("--to-camera-only/--all-directions", help="Only vehicles that drive towards the camera.")
    ] = True,
    limit: Annotated[int | None, typer.Option("--limit", min=1, metavar="N", help="Stop after N crops.")] = None,
    split: Annotated[
        str | None, typer.Option("--split", metavar="NAME", help="Classification split to note in the shards.")
    ] = None,
    per_shard: Annotated[int, typer.Option("--per-shard", min=1, help="Crops in a shard.")] = 1000,
    quality: QualityOption = 95,
    workers: WorkersOption = 0,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Label the 3D boxes of BoxCars116k: rectified crops with 2D box and c_c.

    Every crop becomes a label or is listed with the reason in rejects.jsonl. An interrupted run goes on where it
    stopped when the same command is given again.
    """
    from labelgen.datasets.boxcars116k import BoxCars
    from labelgen.datasets.manifest import find_root, load_manifest
    from labelgen.jobs.boxcars import boxcars_job
    from labelgen.jobs.runner import run_job
    from labelgen.jobs.staging import check_output
    from labelgen.shards.image_codec import ImageCodec

    check_report_path(json_file)
    manifest = load_manifest("boxcars116k")
    size_wh = rectified_size(size, pair, manifest)
    folder = find_root(manifest, root)
    check_output(out, overwrite=overwrite)
    data = BoxCars(folder, manifest["layout"], split, default_split=manifest["splits"]["name"])
    names = _camera_names(cameras, manifest["exclusions"]["cameras"], [*data.cameras, *data.bad_cameras])
    job = boxcars_job(
        data,
        pair,
        size_wh,
        cameras=names,
        to_camera_only=to_camera_only,
        limit=limit,
        per_shard=per_shard,
        codec=ImageCodec(quality or None),
    )
    # The atlas lives in one process's memory.
    with reported(json_file):
        summary = run_job(job, out, overwrite=overwrite, workers=1 if data.from_atlas else workers)
    show_summary(f"BoxCars116k labels, {pair} {size_wh[0]}x{size_wh[1]}", summary, out, json_file)


def _camera_names(text: str, excluded: list[str], known: list[str]) -> list[str] | None:
    if text == "all":
        return None
    if text == "paper":
        return [name for name in known if name not in excluded]
    return [name.strip() for name in text.split(",") if name.strip()]
