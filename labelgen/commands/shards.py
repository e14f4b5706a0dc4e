"""`labelgen inspect`, `labelgen validate` and `labelgen merge`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.commands.common import JsonOption, OverwriteOption, print_table, show_summary, write_json_report

__all__ = ["inspect", "merge", "validate"]

ShardsArgument = Annotated[list[Path], typer.Argument(metavar="SHARDS...", help="Shards, or folders of shards.")]


def inspect(shards: ShardsArgument, json_file: JsonOption = None) -> None:
    """Say what shards hold: counts, sizes, settings and the spread of their labels."""
    import numpy as np

    from labelgen.labels import Flag, Split, VehicleClass
    from labelgen.shards import ShardSet, summarise

    data = ShardSet(shards)
    summary = summarise(data.readers)
    first = data.readers[0]
    boxes, cc = data.table("labels/box"), data.table("labels/cc")
    flags, classes, splits = data.table("labels/flags"), data.table("labels/class"), data.table("samples/split")
    spread = {
        "c_c": cc,
        "box width, px": boxes[:, 2] - boxes[:, 0],
        "box height, px": boxes[:, 3] - boxes[:, 1],
        "labels per image": np.concatenate([np.diff(reader.table("labels/offset")) for reader in data.readers]),
    }
    percentiles = {
        name: {f"p{p}": round(float(np.percentile(values, p)), 4) for p in (1, 25, 50, 75, 99)}
        for name, values in spread.items()
        if len(values)
    }
    details: dict[str, Any] = {
        "pair": sorted({str(reader.pair) for reader in data.readers}),
        "size": sorted({reader.attributes["size"] for reader in data.readers}),
        "format": f"{first.attributes['format']} {first.attributes['version']} by {first.attributes['producer']}",
        "cameras": sorted({camera.name for reader in data.readers for camera in reader.cameras}),
        "settings": first.settings,
        "classes": {c.name.lower(): n for c in VehicleClass if (n := int((classes == c).sum()))},
        "flags": {f.name.lower(): n for f in Flag if f.name and (n := int(((flags & f.value) != 0).sum()))},
        "splits": {s.name.lower(): n for s in Split if (n := int((splits == s).sum()))},
    }
    summary.extra = {key: _plain(value) for key, value in details.items()}
    show_summary(f"{len(data.readers)} shards", summary, None, None)
    typer.echo("spread of the labels")
    print_table([(name, "  ".join(f"{k} {v:g}" for k, v in values.items())) for name, values in percentiles.items()])
    write_json_report(json_file, {**summary.to_dict(), **details, "spread": percentiles})


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items()) or "none"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def validate(shards: ShardsArgument, json_file: JsonOption = None) -> None:
    """Check shards against the format: fields, values, images, content hashes, and the index of each folder.

    Exit code 2 when anything is wrong, with one line for each problem.
    """
    from labelgen.shards import validate_shards

    problems = validate_shards(shards)
    broken = {str(path): found for path, found in problems.items() if found}
    files = [path for path in problems if path.suffix == ".h5"]
    for path, found in broken.items():
        for problem in found:
            typer.echo(f"{path}: {problem}", err=True)
    report = {"shards": len(files), "valid": not broken, "problems": broken}
    write_json_report(json_file, report)
    if broken:
        raise typer.Exit(2)
    typer.echo(f"{len(files)} shards: all valid")


def merge(
    shards: ShardsArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the merged data set.")],
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Put shards of several data sets into one folder with a common index. Their content stays as it is."""
    from labelgen.errors import OutputError
    from labelgen.generate.runner import clear_output
    from labelgen.shards import find_shards, merge_shards

    sources = find_shards(shards)
    if any(path.resolve().parent == out.resolve() for path in sources):
        raise OutputError(f"--out {out}: it is one of the folders to merge; choose another")
    if out.exists() and any(out.glob("shard-*.h5")):
        if not overwrite:
            raise OutputError(f"--out {out}: it already holds shards; add --overwrite or choose another folder")
        clear_output(out, keep_job=True)
    show_summary("Merged", merge_shards(shards, out), out, json_file)
