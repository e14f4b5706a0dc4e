"""`labelgen audit`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from labelgen.cli.options import JsonOption, OverwriteOption, check_report_path, print_table, write_json_report
from labelgen.cli.printing import say

__all__ = ["audit"]


def audit(
    shards: Annotated[list[Path], typer.Argument(metavar="SHARDS...", help="Shards, or folders of shards.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the page and its pictures.")],
    count: Annotated[int, typer.Option("--count", min=1, metavar="N", help="Labels on the contact sheets.")] = 50,
    seed: Annotated[int, typer.Option("--seed", metavar="S", help="Which labels are chosen.")] = 0,
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Look at labels: contact sheets on rectified and original pictures, figures of the steps, statistics."""
    from labelgen.audit.page import make_audit

    check_report_path(json_file)
    made = make_audit(shards, out, count=count, seed=seed, overwrite=overwrite)
    say("Audit")
    print_table([(chapter, f"{len(pictures)} pictures") for chapter, pictures in made.pictures.items()])
    for note in made.notes:
        logging.getLogger(__name__).warning("%s", note)
    say(f"open {made.page}")
    report = {
        "page": str(made.page),
        "pictures": {chapter: [str(picture) for picture in pictures] for chapter, pictures in made.pictures.items()},
        "notes": made.notes,
    }
    write_json_report(json_file, report)
