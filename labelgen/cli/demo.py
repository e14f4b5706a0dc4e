"""`labelgen demo`."""

from __future__ import annotations

import io
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.cli.options import OverwriteOption
from labelgen.cli.printing import say

__all__ = ["demo"]

_STEPS = 7


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything the demo makes.")] = Path(
        "demo"
    ),
    overwrite: OverwriteOption = False,
) -> None:
    """Make synthetic traffic, label it both ways, validate the shards and leave contact sheets to look at.

    Needs no data set and no weights; takes less than a minute.
    """
    from labelgen.cli.audit import audit
    from labelgen.cli.shards import validate
    from labelgen.datasets.manifest import load_manifest
    from labelgen.errors import OutputError

    if out.exists() and any(out.iterdir()) and not overwrite:
        raise OutputError(f"{out}: it is not empty; choose another folder", parameter="overwrite")
    plan = load_manifest("demo")
    data, shards, audits = out / "data", out / "shards", out / "audit"
    sheets = {name: audits / name / "labels-00.png" for name in ("boxcars", "masks")}

    _label_crops(data / "BoxCars116k", shards / "boxcars", plan["boxcars"])
    with _step(3, f"labelgen audit {shards / 'boxcars'} --out {audits / 'boxcars'}"):
        audit([shards / "boxcars"], out=audits / "boxcars", count=plan["audit"]["labels"], overwrite=True)
    say(f"    first contact sheet: {sheets['boxcars']}")
    _label_video(data, shards / "masks", plan["session"])
    with _step(6, f"labelgen audit {shards / 'masks'} --out {audits / 'masks'}"):
        audit([shards / "masks"], out=audits / "masks", count=plan["audit"]["labels"], overwrite=True)
    with _step(7, f"labelgen validate {shards / 'boxcars'} {shards / 'masks'}"):
        validate([shards / "boxcars", shards / "masks"])
    say("Look at:")
    for name, sheet in sheets.items():
        say(f"  {sheet}  or the page {audits / name / 'index.html'}")


def _label_crops(tree: Path, shards: Path, crops: dict[str, Any]) -> None:
    """Render a BoxCars116k tree and label it."""
    from labelgen.cli.boxcars import boxcars
    from labelgen.synth.truth.boxcars116k import write_boxcars_tree

    with _step(1, f"render crops of {crops['vehicles']} vehicles in the layout of BoxCars116k: {tree}"):
        write_boxcars_tree(
            tree, crops["vehicles"], crops["seed"], cameras=crops["cameras"], kinds=crops["kinds"], overwrite=True
        )
    with _step(2, f"labelgen boxcars --root {tree} --out {shards}"):
        boxcars(root=tree, out=shards, overwrite=True)


def _label_video(data: Path, shards: Path, clip: dict[str, Any]) -> None:
    """Render a session of BrnoCompSpeed and label it through its exact masks, so that only the method errs."""
    from labelgen.choices import parse_size
    from labelgen.cli.bcs_masks import bcs_masks
    from labelgen.synth.shading.lighting import Weather
    from labelgen.synth.truth.session import write_session

    with _step(4, f"render {clip['duration_s']:g} s of video in the layout of BrnoCompSpeed: {data}"):
        made = write_session(
            data,
            duration_s=clip["duration_s"],
            fps=clip["fps"],
            size_wh=parse_size(clip["size"]),
            seed=clip["seed"],
            weather=Weather(clip["weather"]),
            overwrite=True,
        )
    session, masks = data / "dataset" / made.name, f"coco:{made.files['masks']}"
    with _step(5, f"labelgen bcs-masks {session} --masks {masks} --every {clip['every']} --out {shards}"):
        bcs_masks([session], out=shards, masks=masks, every=clip["every"], overwrite=True)


@contextmanager
def _step(number: int, text: str) -> Iterator[None]:
    """Print a line for a step and how long it took; what the step itself prints is dropped, warnings are not."""
    say(f"{number}/{_STEPS} {text} ", nl=False)
    start = time.monotonic()
    log = logging.getLogger("labelgen")
    level = log.level
    log.setLevel(max(level, logging.WARNING))
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        log.setLevel(level)
        say(f"({time.monotonic() - start:.0f} s)")
