"""What the commands share: options, checks of outputs, the closing summary, --json."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from labelgen.atomic_files import write_json
from labelgen.choices import Pair, Rule, parse_size
from labelgen.cli.printing import say
from labelgen.errors import LabelgenError, NoVehiclesError, OutputError
from labelgen.json_file import parse_json

if TYPE_CHECKING:
    from labelgen.masks.mask_options import MaskOptions
    from labelgen.shards.index import DatasetSummary

__all__ = [
    "APP_SETTINGS",
    "CalibrationOption",
    "ClassesOption",
    "ContactPoint",
    "Cover",
    "DeinterlaceOption",
    "FirstFrameOption",
    "FpsOption",
    "Heading",
    "JsonOption",
    "KeyframesOption",
    "OverwriteOption",
    "PairOption",
    "QualityOption",
    "RoadMaskOption",
    "RuleOption",
    "ScaleMasksOption",
    "SceneSizeOption",
    "StreamOption",
    "TilesOption",
    "WorkersOption",
    "check_new_file",
    "check_report_path",
    "mask_options",
    "picture_suffix",
    "print_table",
    "rectified_size",
    "reported",
    "show_summary",
    "warn_of",
    "write_json_report",
]

_log = logging.getLogger(__name__)

# Of every Typer application: no completion to install, plain help.
APP_SETTINGS: dict[str, Any] = {
    "add_completion": False,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"], "max_content_width": 110},
}


class ContactPoint(StrEnum):
    """Where a mask's vehicle ends towards the camera."""

    VEHICLE = "vehicle"
    OUTLINE = "outline"


class Cover(StrEnum):
    """What fills 80 % of a rectified picture."""

    FRAME = "frame"
    MASK = "mask"


class Heading(StrEnum):
    """Which way traffic drives."""

    AWAY = "away"
    CLOSER = "closer"


PairOption = Annotated[
    Pair,
    typer.Option(
        "--pair",
        case_sensitive=False,
        metavar="VP2-VP3|VP1-VP2",
        help="Vanishing points whose directions become axis-parallel.",
    ),
]
RuleOption = Annotated[
    Rule, typer.Option("--rule", case_sensitive=False, help="How the two candidates of c_c become one.")
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration", metavar="FILE", help="Camera JSON; else the session's, NAME.calibration.json, or made."
    ),
]
RoadMaskOption = Annotated[
    Path | None,
    typer.Option("--road-mask", metavar="FILE", help="Road mask; else the session's, NAME.mask.png, or made."),
]
SceneSizeOption = Annotated[
    str | None,
    typer.Option("--size", metavar="WxH", help="Rectified size; 640x360 by default, 360x640 for VP1-VP2."),
]
FirstFrameOption = Annotated[
    int | None,
    typer.Option(
        "--first-frame", min=0, metavar="N", help="Number of the first frame in a COCO file; 0, or as its numbers show."
    ),
]
ScaleMasksOption = Annotated[
    bool, typer.Option("--scale-masks", help="Scale a COCO file's masks of another frame size and the same ratio.")
]
ClassesOption = Annotated[
    str | None,
    typer.Option(
        "--classes",
        metavar="FILE_OR_MAP",
        help="What a COCO file's or a network's classes are, by name or number: 2=car,pickup=car; or a file of that.",
    ),
]
TilesOption = Annotated[
    str | None,
    typer.Option(
        "--tiles",
        metavar="auto|CxR",
        help="Parts of the frame that a network of masks onnx:FILE sees enlarged: auto, for distant vehicles by the "
        "calibration; or columns and rows, as 3x2.",
    ),
]
KeyframesOption = Annotated[
    bool,
    typer.Option("--keyframes", help="Take only frames that decode alone: much faster, at places the camera chose."),
]
FpsOption = Annotated[
    float | None,
    typer.Option(
        "--fps",
        min=0.001,
        max=1000.0,
        metavar="RATE",
        help="Frames per second of images, raw streams and AVI files; time stamps of other files come first.",
    ),
]
StreamOption = Annotated[
    int | None,
    typer.Option(
        "--stream", min=0, metavar="N", help="Which of several video streams, from 0; the largest by default."
    ),
]
DeinterlaceOption = Annotated[
    bool, typer.Option("--deinterlace", help="Deinterlace a video: one whole frame for each frame of two fields.")
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace what the output already holds. Without it, nothing is replaced.")
]
JsonOption = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the closing summary as JSON as well.")
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="Processes; 0 for one per core. Any number gives the same bytes.")
]
QualityOption = Annotated[
    int, typer.Option("--quality", metavar="Q", help="JPEG quality of the images, 1 to 100; 0 for lossless PNG.")
]


def print_table(rows: list[tuple[str, Any]]) -> None:
    """Print two aligned columns on standard output."""
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        say(f"  {name:<{width}}  {value}")


_LARGEST_REPORT = 16_000_000
_OTHER_CONTENT = {"camera_calibration", "annotations", "cars", "info", "categories"}


def _is_report(path: Path) -> bool:
    """Return whether a file may be a report of an earlier run: a JSON object that is no input of any command."""
    try:
        if not path.is_file() or path.stat().st_size > _LARGEST_REPORT:
            return False
        data = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, LabelgenError, RecursionError):
        return False
    return isinstance(data, dict) and not _OTHER_CONTENT & data.keys()


def check_report_path(path: Path | None, *others: Path | None) -> None:
    """Refuse a --json that could not be written after all the work, or that is another output's file."""
    if path is None:
        return
    if path.is_dir():
        raise OutputError(f"--json {path}: it is a folder; name a file")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise OutputError(f"--json {path}: its folder is missing or cannot be written; choose another file")
    if path.exists() and not _is_report(path):
        raise OutputError(f"--json {path}: it exists and is no report of labelgen; choose another file")
    if any(other is not None and other.resolve() == path.resolve() for other in others):
        raise OutputError(f"--json {path}: it is the output itself; choose another file")


def check_new_file(option: str, path: Path | None, overwrite: bool, inputs: Sequence[Path | None] = ()) -> None:
    """Refuse a file to write that is a folder, an input, or that is there already without --overwrite."""
    if path is not None and any(other is not None and other.resolve() == path.resolve() for other in inputs):
        raise OutputError(f"{option} {path}: it is an input itself; choose another name")
    if path is not None and path.is_dir():
        raise OutputError(f"{option} {path}: it is a folder; name a file")
    if path is not None and path.exists() and not overwrite:
        raise OutputError(f"{option} {path}: it exists; add --overwrite or choose another name")


def picture_suffix(option: str, path: Path) -> str:
    """Return the suffix of a picture to write, in lower case; refuse what is neither PNG nor JPEG."""
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg"):
        raise OutputError(f"{option} {path}: name a .png or .jpg file")
    return suffix


def rectified_size(size: str | None, pair: Pair, manifest: dict[str, Any]) -> tuple[int, int]:
    """Return the size (width, height) px that was asked for, or the data set's for the pair."""
    return parse_size(size or manifest["sizes"][str(pair)])


def mask_options(
    first_frame: int | None, scale_masks: bool, classes: str | None, tiles: str | None = None
) -> MaskOptions:
    """Return the options of a mask source."""
    from labelgen.masks.class_names import parse_classes
    from labelgen.masks.mask_options import MaskOptions

    return MaskOptions(first_frame, scale_masks, None if classes is None else parse_classes(classes), tiles)


def write_json_report(path: Path | None, data: Any) -> None:
    """Write --json, if asked for."""
    if path is not None:
        write_json(path, data)


def warn_of(problems: Sequence[str]) -> None:
    """Print problems as warnings."""
    for problem in problems:
        _log.warning("%s", problem)


@contextmanager
def reported(json_file: Path | None) -> Iterator[None]:
    """Print the problems, and write --json, where the block finds no vehicles."""
    try:
        yield
    except NoVehiclesError as err:
        warn_of(err.problems)
        write_json_report(json_file, {"error": str(err), "problems": list(err.problems)})
        raise


def show_summary(title: str, summary: DatasetSummary, out: Path | None, json_file: Path | None) -> None:
    """Print the closing table and write --json."""
    say(title)
    rows: list[tuple[str, Any]] = [
        ("images", summary.images),
        ("labels", summary.labels),
        ("rejects", summary.rejects),
        *((f"  {reason}", count) for reason, count in summary.reasons.most_common()),
        *([("ignored boxes", summary.ignored.total())] if summary.ignored else []),
        *((f"  {reason}", count) for reason, count in summary.ignored.most_common()),
        ("shards", summary.shards),
        *summary.extra.items(),
    ]
    if out is not None:
        rows.append(("in", out))
    print_table(rows)
    for line in summary.notes:
        _log.info("%s", line)
    warn_of([*summary.warnings, *summary.problems])
    write_json_report(json_file, {**summary.to_dict(), **({"out": str(out)} if out is not None else {})})
