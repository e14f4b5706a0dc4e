"""`labelgen inspect`, `labelgen validate` and `labelgen merge`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.cli.options import (
    JsonOption,
    OverwriteOption,
    check_report_path,
    print_table,
    show_summary,
    write_json_report,
)
from labelgen.cli.printing import say

__all__ = ["inspect", "merge", "validate"]

ShardsArgument = Annotated[list[Path], typer.Argument(metavar="SHARDS...", help="Shards, or folders of shards.")]


def inspect(shards: ShardsArgument, json_file: JsonOption = None) -> None:
    """Say what shards hold: counts, sizes, settings and the spread of their labels."""
    import numpy as np

    from labelgen.labels import Flag, Split, VehicleClass
    from labelgen.shards import ShardDataset, summarise

    check_report_path(json_file)
    data = ShardDataset(shards)
    summary = summarise(data.readers)
    summary.warnings += _unfinished(shards)
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
        "settings": _distinct(reader.settings for reader in data.readers),
        "classes": {c.name.lower(): n for c in VehicleClass if (n := int((classes == c).sum()))},
        "flags": {f.name.lower(): n for f in Flag if f.name and (n := int(((flags & f.value) != 0).sum()))},
        "splits": {s.name.lower(): n for s in Split if (n := int((splits == s).sum()))},
    }
    summary.extra = {key: _plain(value) for key, value in details.items()}
    show_summary(f"{len(data.readers)} shards", summary, None, None)
    say("spread of the labels")
    print_table([(name, "  ".join(f"{k} {v:g}" for k, v in values.items())) for name, values in percentiles.items()])
    write_json_report(json_file, {**summary.to_dict(), **details, "spread": percentiles})


def _distinct(settings: Iterable[dict[str, Any]]) -> Any:
    """The settings all shards share, or the list of those there are."""
    distinct: list[dict[str, Any]] = []
    for one in settings:
        if one not in distinct:
            distinct.append(one)
    return distinct[0] if len(distinct) == 1 else distinct


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items()) or "none"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def validate(shards: ShardsArgument, json_file: JsonOption = None) -> None:
    """Check shards against the format: fields, values, images, content hashes, and the index of each folder.

    Exit code 2 when anything is wrong, with one line for each problem.
    """
    from labelgen.shards import validate_shards

    check_report_path(json_file)
    problems = validate_shards(shards)
    broken = {str(path): lines for path, lines in problems.items() if lines}
    files = [path for path in problems if path.suffix == ".h5"]
    for path, lines in broken.items():
        for problem in lines:
            said = problem.removeprefix(f"{path}: ")
            say(f"labelgen: error: {path}: {said}", err=True)
    report = {"shards": len(files), "valid": not broken, "problems": broken}
    write_json_report(json_file, report)
    if broken:
        raise typer.Exit(2)
    say(f"{len(files)} shards: all valid")


def merge(
    shards: ShardsArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the merged data set.")],
    overwrite: OverwriteOption = False,
    json_file: JsonOption = None,
) -> None:
    """Put shards of several data sets into one folder with a common index. Their samples stay as they are."""
    from labelgen.errors import OutputError
    from labelgen.jobs.staging import Staging, check_output
    from labelgen.shards import ShardReader, find_shards, merge_shards, summarise
    from labelgen.shards.merge import merge_job

    sources = find_shards(shards)
    if any(path.resolve().parent == out.resolve() for path in sources):
        raise OutputError(f"--out {out}: it is one of the folders to merge; choose another")
    check_report_path(json_file)
    check_output(out, overwrite=overwrite)
    with Staging(out, merge_job(sources), overwrite=overwrite) as staging:
        if staging.published:  # an earlier run of the same command was interrupted while publishing
            summary = summarise([ShardReader(path) for path in find_shards([out])])
        else:
            try:
                summary = merge_shards(shards, staging.path)
            except BaseException:
                staging.discard()
                raise
            staging.publish()
    summary.warnings += _unfinished(shards)
    show_summary("Merged", summary, out, json_file)


def _unfinished(paths: list[Path]) -> list[str]:
    """A note for each folder without an index: its data set may not be whole."""
    from labelgen.shards.index import INDEX_NAME

    bare = [path for path in paths if path.is_dir() and not (path / INDEX_NAME).exists()]
    return [f"{path}: no {INDEX_NAME}, so this data set may not be complete" for path in bare]
