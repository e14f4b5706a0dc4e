"""The page of the command line, made from the typer application.

    python -m tools.docs.command_line        # prints the page

mkdocs puts it at docs/reference/command-line.md while it builds the site (`tools.docs.hooks`), so it is never out of
date.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer.main

from labelgen.cli.main import app

__all__ = ["PAGE", "command_line_page", "subcommands"]

PAGE = "reference/command-line.md"
"""Where the page stands, below docs/."""

_INTRODUCTION = """# Command line

Made from the commands themselves by `tools/docs/command_line.py`. `labelgen COMMAND --help` shows the
same in a terminal. `labelgen` can also be called as `python -m labelgen`.

Exit codes: 0 done; 2 something to mend, with one line that says what; 130 interrupted.
"""


def command_line_page() -> str:
    """Return the page as Markdown: a section for each command, with its arguments and options."""
    root: Any = typer.main.get_command(app)
    parts = [_INTRODUCTION, *_section("labelgen", root)]
    for name, command in _commands("labelgen", root):
        parts += _section(name, command)
    return "\n".join(parts)


def subcommands(name: str, group: Any) -> dict[str, Any]:
    """Return the commands of a group by their names; empty for a plain command.

    Args:
        name: full name of the group.
        group: the command; groups may load their commands when they are asked for.
    """
    if not hasattr(group, "list_commands"):
        return {}
    context = group.make_context(name, [], resilient_parsing=True)
    return {sub: group.get_command(context, sub) for sub in group.list_commands(context)}


def _commands(prefix: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Yield full name and command of everything below a group."""
    for name, command in subcommands(prefix, group).items():
        full_name = f"{prefix} {name}"
        yield full_name, command
        yield from _commands(full_name, command)


def _section(name: str, command: Any) -> list[str]:
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(command.get_usage(context).removeprefix("Usage:").split())
    parts = [f"## `{name}`\n", f"```text\n{usage}\n```\n"]
    parts += [f"{paragraph}\n" for paragraph in _paragraphs(command.help or "")]
    records = [(parameter, parameter.get_help_record(context)) for parameter in command.get_params(context)]
    for kind, title in (("argument", "Argument"), ("option", "Option")):
        rows = [(f"`{_cell(names)}`", _cell(text)) for parameter, (names, text) in _of_kind(records, kind)]
        if rows:
            parts.append(_table((title, "Meaning"), rows))
    rows = [
        (f"[`{sub}`](#{f'{name} {sub}'.replace(' ', '-')})", _cell(below.get_short_help_str(limit=200)))
        for sub, below in subcommands(name, command).items()
    ]
    if rows:
        parts.append(_table(("Command", "What it does"), rows))
    return parts


def _of_kind(records: list[tuple[Any, Any]], kind: str) -> list[tuple[Any, Any]]:
    """Return the records of arguments or of options; hidden parameters have none."""
    return [(p, record) for p, record in records if record is not None and p.param_type_name == kind]


def _paragraphs(text: str) -> list[str]:
    return [" ".join(block.split()) for block in text.split("\n\n") if block.strip()]


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|")


def _table(head: tuple[str, str], rows: list[tuple[str, str]]) -> str:
    lines = [f"| {head[0]} | {head[1]} |", "| --- | --- |", *(f"| {name} | {text} |" for name, text in rows)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(command_line_page())
