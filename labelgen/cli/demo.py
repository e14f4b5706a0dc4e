"""`labelgen demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labelgen.cli.options import OverwriteOption

__all__ = ["demo"]


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    overwrite: OverwriteOption = False,
) -> None:
    """Make synthetic traffic, label it both ways, validate the shards and leave audits to look at.

    Needs no data set and no weights; takes a minute or two.
    """
    from labelgen.choices import parse_size
    from labelgen.cli.audit import audit
    from labelgen.cli.bcs_masks import bcs_masks
    from labelgen.cli.boxcars import boxcars
    from labelgen.cli.shards import validate
    from labelgen.datasets.manifest import load_manifest
    from labelgen.errors import OutputError
    from labelgen.synth.shading.lighting import Weather
    from labelgen.synth.truth.boxcars116k import write_boxcars_tree
    from labelgen.synth.truth.session import write_session

    plan = load_manifest("demo")
    data, shards, audits = out / "data", out / "shards", out / "audit"
    if out.exists() and any(out.iterdir()) and not overwrite:
        raise OutputError(f"--out {out}: it is not empty; add --overwrite or choose another folder")
    tree = data / "BoxCars116k"
    typer.echo(f"1/5 rendering crops in the BoxCars116k layout: {tree}")
    crops = plan["boxcars"]
    write_boxcars_tree(tree, crops["vehicles"], crops["seed"], overwrite=True, progress=True)
    clip = plan["session"]
    typer.echo(f"2/5 rendering {clip['duration_s']:g} s of traffic in the BrnoCompSpeed layout: {data}")
    made = write_session(
        data,
        duration_s=clip["duration_s"],
        fps=clip["fps"],
        size_wh=parse_size(clip["size"]),
        seed=clip["seed"],
        weather=Weather(clip["weather"]),
        overwrite=True,
        progress=True,
    )
    session = next(iter(sorted((data / "dataset").iterdir())))
    typer.echo(f"\n3/5 labelgen boxcars --root {tree} --out {shards / 'boxcars'}")
    boxcars(root=tree, out=shards / "boxcars", overwrite=True)
    # Exact masks, so that what is seen of the labels is the method's own.
    masks = f"coco:{made.files['masks']}"
    typer.echo(f"\n4/5 labelgen bcs-masks {session} --masks {masks} --every {clip['every']} --out {shards / 'masks'}")
    bcs_masks([session], out=shards / "masks", masks=masks, every=clip["every"], overwrite=True)
    typer.echo(f"\n5/5 labelgen validate and labelgen audit {shards / 'boxcars'} {shards / 'masks'}")
    validate([shards / "boxcars", shards / "masks"])
    for name in ("boxcars", "masks"):
        audit([shards / name], out=audits / name, overwrite=True)
    typer.echo("\nLook at the labels:")
    for name in ("boxcars", "masks"):
        typer.echo(f"  {audits / name / 'index.html'}  (or {audits / name / 'labels-00.png'})")
