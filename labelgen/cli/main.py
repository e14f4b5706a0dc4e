"""The `labelgen` command: finds the command by its name, and turns errors into one line and an exit code.

A command's file is imported when the command is called, so that `labelgen --help` needs no array library.
"""

from __future__ import annotations

import logging
import re
import shlex
import signal
import sys
from collections.abc import Callable, Collection, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from labelgen.cli.foreign_messages import counted_foreign_messages
from labelgen.cli.notes import LOGGERS, finish_notes, name_options, notes_beside, notes_on_screen, options_in_notes
from labelgen.cli.options import APP_SETTINGS
from labelgen.cli.printing import EndedBySignalError, say
from labelgen.errors import LabelgenError, NoWeightsError
from labelgen.interruption import signal_of, terminate_as_interrupt
from labelgen.printable import printable
from labelgen.version import __version__

__all__ = ["app", "main"]


class _Entry(NamedTuple):
    """Where a command is: `module:name` of its function or of a Typer application, and its line in the overview."""

    place: str
    help: str


_COMMANDS = {
    "boxcars": _Entry("boxcars:boxcars", "BoxCars116k's 3D boxes -> shards."),
    "bcs-masks": _Entry("bcs_masks:bcs_masks", "Traffic videos, through vehicle masks -> shards."),
    "calibrate": _Entry("calibrate:calibrate", "Calibrate a camera from its video alone."),
    "rectify": _Entry("rectify:rectify", "Rectify one picture of a scene."),
    "road-mask": _Entry("road_mask:road_mask", "Mark the road in a video."),
    "inspect": _Entry("shards:inspect", "Say what shards hold."),
    "validate": _Entry("shards:validate", "Check shards and their index."),
    "merge": _Entry("shards:merge", "Put shards of several data sets into one folder."),
    "audit": _Entry("audit:audit", "Look at labels: contact sheets, figures, statistics."),
    "demo": _Entry("demo:demo", "Synthetic traffic, labelled both ways, to look at."),
    "synth": _Entry("synth:synth_app", "Synthetic traffic with exact truth, in the real layouts."),
    "speed": _Entry("speed:speed", "Tracks and speeds of the vehicles in a video."),
    "evaluate": _Entry("evaluate:evaluate", "Score tracks and speeds by the public protocols."),
    "train": _Entry("train:train", "Train the detector on shards."),
    "test-detector": _Entry("evaluate_detector:evaluate_detector", "Judge a detector on labelled shards."),
    "detect": _Entry("detect:detect", "Find vehicles in videos, images or shards."),
    "export-model": _Entry("export_model:export_model", "Write a detector as ONNX."),
}
# Parameters of the library whose option has another name.
_OPTION_OF = {
    "size_wh": "size",
    "masks": "from_",
    "kinds": "bodies",
    "start_s": "start",
    "correct_contact_point": "near_end",
}
# Where a library says that something is there already, another place is the other way out.
_OTHER_WAY = {"overwrite": "out"}
# Options whose value is one of several words: blanks around it do no harm.
_WORD_OPTIONS = {
    "--cover",
    "--format",
    "--heading",
    "--near-end",
    "--pair",
    "--region",
    "--rule",
    "--variant",
    "--weather",
}


# Where a command keeps its arguments as they were given.
_ARGUMENTS = "labelgen.arguments"


# Commands that find what an interrupted run of theirs has made.
_RESUMED_BY_THEMSELVES = ("labelgen boxcars", "labelgen bcs-masks")
_GOES_ON = "the same command goes on where it stopped"


class _Command(TyperCommand):
    """A command that says in which option a wrong parameter was given."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        words = zip(["", *args], args, strict=False)
        ctx.meta[_ARGUMENTS] = tuple(args)
        return super().parse_args(ctx, [arg.strip() if option in _WORD_OPTIONS else arg for option, arg in words])

    def invoke(self, ctx: Any) -> Any:
        known = {option for parameter in self.params for option in parameter.opts}
        options_in_notes(known)
        if isinstance(ctx.params.get("out"), Path):
            notes_beside(ctx.params["out"])
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as err:
            goes_on = _GOES_ON if ctx.command_path in _RESUMED_BY_THEMSELVES else ""
            raise EndedBySignalError(signal_of(err), goes_on) from None
        except LabelgenError as err:
            options = {parameter.name: parameter.opts[0] for parameter in self.params}
            parameters = [*err.parameters, *(_OTHER_WAY[name] for name in err.parameters if name in _OTHER_WAY)]
            names = [options.get(name) or options.get(_OPTION_OF.get(name, "")) for name in parameters]
            commands = self._other_commands(ctx, err.other_masks) if isinstance(err, NoWeightsError) else []
            given = list(dict.fromkeys(name for name in names if name is not None))
            raise _OptionError(err, given, commands, known) from err

    def _other_commands(self, ctx: Any, other_masks: Sequence[str]) -> list[str]:
        """Return the given command with other masks."""
        name = next(option for option in ("--masks", "--from") if any(option in one.opts for one in self.params))
        given: list[str] = list(ctx.meta[_ARGUMENTS])
        while (at := next((i for i, word in enumerate(given) if word.partition("=")[0] == name), None)) is not None:
            del given[at : at + (1 if "=" in given[at] else 2)]
        prefix = "masks:" if name == "--from" else ""
        start = ["labelgen", ctx.info_name, *given]
        return [printable(shlex.join([*start, name, f"{prefix}{masks}"])) for masks in other_masks]


class _OptionError(LabelgenError):
    """An error of the library, with the options that it is about."""

    def __init__(
        self, err: LabelgenError, options: Sequence[str], commands: Sequence[str], known: Collection[str]
    ) -> None:
        text = name_options(" ".join(str(err).split()), known)
        first = err.parameters[0] if err.parameters else ""
        # `--from masks:x` is more than the parameter `masks`: there the option stands at the end.
        leads = bool(first) and re.match(rf"{re.escape(first)}(?![\w.])", text) is not None
        if options and leads and (options[0] != "--from" or first == "from_"):
            text = options[0] + text.removeprefix(first)
        if others := [option for option in options if option not in text]:
            text += f" (option{'s' if len(others) > 1 else ''} {', '.join(others)})"
        super().__init__(f"{text}: {'; or: '.join(commands)}" if commands else text)


class _Commands(TyperGroup):
    """The commands of the table, each imported when it is called."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(_COMMANDS)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        # The names that Typer suggests for a misspelt one.
        self.commands = dict.fromkeys(_COMMANDS)  # type: ignore[assignment]
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        entry = _COMMANDS.get(cmd_name)
        if entry is None:
            return None
        module, name = entry.place.split(":")
        function = getattr(import_module(f"labelgen.cli.{module}"), name)
        if isinstance(function, typer.Typer):
            for command in function.registered_commands:
                command.cls = _Command
            return typer.main.get_command(function)
        application = typer.Typer(**APP_SETTINGS)
        application.command(cmd_name, short_help=entry.help, cls=_Command)(function)
        return typer.main.get_command(application)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as err:
            raise EndedBySignalError(signal_of(err)) from None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in _COMMANDS.items()])


app = typer.Typer(
    name="labelgen",
    cls=_Commands,
    no_args_is_help=True,
    **APP_SETTINGS,
)


def _version(show: bool) -> None:
    if show:
        say(f"labelgen {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Show the version."),
    verbose: bool = typer.Option(False, "--verbose", "-v", help="Say more about what is being done."),
    quiet: bool = typer.Option(False, "--quiet", "-q", help="Say only what went wrong."),
) -> None:
    """Labels for monocular 3D vehicle detection and speed measurement from traffic cameras."""
    level = logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO
    for name in LOGGERS:
        logging.getLogger(name).setLevel(level)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. Exit codes: 0 done, 2 something to mend, 130 interrupted, 143 terminated."""
    with notes_on_screen(), terminate_as_interrupt() as terminated:
        sys.exit(_run(list(sys.argv[1:] if arguments is None else arguments), terminated))


def _run(arguments: list[str], terminated: Callable[[], bool]) -> int:
    try:
        with counted_foreign_messages():
            code = app(args=arguments, prog_name="labelgen", standalone_mode=False)
    except LabelgenError as err:
        _fail(" ".join(str(err).split()))
    except EndedBySignalError as err:
        return _interrupted(err)
    except KeyboardInterrupt as err:
        return _interrupted(EndedBySignalError(signal_of(err)))
    except OSError as err:
        # Names too long, loops of links, folders that vanish: whatever no command looked for.
        where = f" {err.filename}" if err.filename else ""
        _fail(f"cannot use{where}: {err.strerror or err}")
    except Exception as err:
        if type(err).__name__ == "Abort":  # what Typer makes of an interruption
            return _interrupted(EndedBySignalError(signal_of(err.__cause__)))
        # Typer's own errors, such as an unknown option; anything else is a bug and keeps its traceback.
        message = getattr(err, "format_message", None)
        if message is None:
            raise
        context = getattr(err, "ctx", None)
        hint = f"; see {context.command_path} --help" if context is not None else ""
        text = " ".join(message().split()).replace("Value error, ", "")
        if type(err).__name__ == "NoArgsIsHelpError":
            typer.echo(message() or (context.get_help() if context is not None else ""), err=True)
            return 2
        _fail(f"{text.rstrip('.')}{hint}")
    if code == 128 + signal.SIGINT:  # what Typer makes of either signal, before a command begins
        return _interrupted(EndedBySignalError(int(signal.SIGTERM if terminated() else signal.SIGINT)))
    return code if isinstance(code, int) else 0


def _interrupted(err: EndedBySignalError) -> int:
    finish_notes()
    word = "terminated" if err.signal == signal.SIGTERM else "interrupted"
    say(f"labelgen: {word}" + (f"; {err}" if str(err) else ""), err=True)
    return 128 + err.signal


def _fail(message: str) -> NoReturn:
    finish_notes()
    say(f"labelgen: error: {message}", err=True)
    sys.exit(2)
