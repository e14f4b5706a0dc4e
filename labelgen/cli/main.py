"""The `labelgen` command: puts the commands together and turns errors into one line and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn

import typer

from labelgen import __version__
from labelgen.cli.audit import audit
from labelgen.cli.bcs_masks import bcs_masks
from labelgen.cli.boxcars import boxcars
from labelgen.cli.calibrate import calibrate
from labelgen.cli.demo import demo
from labelgen.cli.detect import detect
from labelgen.cli.evaluate import evaluate
from labelgen.cli.evaluate_detector import detector_test
from labelgen.cli.export_model import export_model
from labelgen.cli.rectify import rectify
from labelgen.cli.road_mask import road_mask
from labelgen.cli.shards import inspect, merge, validate
from labelgen.cli.speed import speed
from labelgen.cli.synth import synth_app
from labelgen.cli.train import train
from labelgen.errors import LabelgenError

__all__ = ["app", "main"]

app = typer.Typer(
    name="labelgen",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"labelgen {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Show the version."),
) -> None:
    """Labels for monocular 3D vehicle detection and speed measurement from traffic cameras."""


app.command("boxcars", short_help="BoxCars116k's 3D boxes -> shards.")(boxcars)
app.command("bcs-masks", short_help="Traffic videos, through vehicle masks -> shards.")(bcs_masks)
app.command("calibrate", short_help="Calibrate a camera from its video alone.")(calibrate)
app.command("rectify", short_help="Rectify one picture of a scene.")(rectify)
app.command("road-mask", short_help="Mark the road in a video.")(road_mask)
app.command("inspect", short_help="Say what shards hold.")(inspect)
app.command("validate", short_help="Check shards and their index.")(validate)
app.command("merge", short_help="Put shards of several data sets into one folder.")(merge)
app.command("audit", short_help="Look at labels: contact sheets, figures, statistics.")(audit)
app.command("demo", short_help="Synthetic traffic, labelled both ways, to look at.")(demo)
app.add_typer(synth_app, name="synth", short_help="Synthetic traffic with exact truth, in the real layouts.")
app.command("speed", short_help="Tracks and speeds of the vehicles in a video.")(speed)
app.command("evaluate", short_help="Score tracks and speeds by the public protocols.")(evaluate)
app.command("train", short_help="Train the detector on shards.")(train)
app.command("test-detector", short_help="Judge a detector on labelled shards.")(detector_test)
app.command("detect", short_help="Find vehicles in videos, images or shards.")(detect)
app.command("export-model", short_help="Write a detector as ONNX.")(export_model)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. Exit codes: 0 done, 2 something to mend, 130 interrupted."""
    try:
        given = list(sys.argv[1:] if arguments is None else arguments)
        code = app(args=given, prog_name="labelgen", standalone_mode=False)
    except LabelgenError as err:
        _fail(" ".join(str(err).split()))
    except KeyboardInterrupt:
        _interrupted()
    except OSError as err:
        # Names too long, loops of links, folders that vanish: whatever no command looked for.
        where = f" {err.filename}" if err.filename else ""
        _fail(f"cannot use{where}: {err.strerror or err}")
    except Exception as err:
        if type(err).__name__ == "Abort":  # what click makes of an interruption
            _interrupted()
        # Click's own errors, such as an unknown option; anything else is a bug and keeps its traceback.
        message = getattr(err, "format_message", None)
        if message is None:
            raise
        context = getattr(err, "ctx", None)
        hint = f"; see {context.command_path} --help" if context is not None else ""
        _fail(f"{' '.join(message().split()).rstrip('.')}{hint}")
    sys.exit(code if isinstance(code, int) else 0)


def _interrupted() -> NoReturn:
    typer.echo("labelgen: interrupted; the same command goes on where it stopped", err=True)
    sys.exit(130)


def _fail(message: str) -> NoReturn:
    typer.echo(f"labelgen: error: {message}", err=True)
    sys.exit(2)
