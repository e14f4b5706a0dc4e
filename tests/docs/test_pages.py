"""What the pages say of commands, files and rooms is checked against the code."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer.main

from labelgen.cli.main import app
from tools.docs.command_line import command_line_page, subcommands
from tools.docs.house import draw_house, read_layers, room_imports, without_shortcuts

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
LONGEST_LINE = 100


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_lines_of_prose_are_short(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    long = [line for line in text.splitlines() if len(line) > LONGEST_LINE and not line.lstrip().startswith("|")]
    assert long == []


def commands_in(page: Path) -> list[str]:
    """Return the lines of a page's code that call labelgen, continued lines joined, without their comments."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    fenced = "\n".join(re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))
    calls = re.findall(r"^labelgen .*", fenced, re.MULTILINE) + re.findall(
        r"^ {4,}(labelgen [a-z].*)", text, re.MULTILINE
    )
    return [call.split(" #")[0] for call in calls]


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_commands_and_options_of_the_pages_exist(page: Path) -> None:
    root: Any = typer.main.get_command(app)
    for line in commands_in(page):
        words = shlex.split(re.sub(r"\[|\]|\.\.\.", " ", line))[1:]
        command = root
        while words and words[0] != "COMMAND" and (below := subcommands("labelgen", command)):
            assert words[0] in below, line
            command = below[words.pop(0)]
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        used = {word for word in words if word.startswith("--")} - {"--help"}
        assert used <= known, f"{line}: {sorted(used - known)}"


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_options_in_the_text_of_the_pages_exist(page: Path) -> None:
    root: Any = typer.main.get_command(app)
    commands = [root, *subcommands("labelgen", root).values()]
    commands += [below for command in commands[1:] for below in subcommands("labelgen x", command).values()]
    known = {o for command in commands for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
    spans = re.findall(r"`(--[a-z][^`]*|labelgen [^`]*)`", page.read_text(encoding="utf-8"))
    named = {option for span in spans for option in re.findall(r"(?<![\w-])--[a-z][a-z-]+", span)}
    # The programs of studies and benchmarks have options of their own.
    tools = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tools").rglob("*.py"))
    parameters = {f"--{word.replace('_', '-')}" for word in re.findall(r"^    (\w+): ", tools, re.MULTILINE)}
    assert named <= known | parameters | set(re.findall(r"add_argument\(\s*\"(--[a-z-]+)\"", tools))


def test_the_command_line_page_has_every_command() -> None:
    text = command_line_page()
    root: Any = typer.main.get_command(app)
    names = subcommands("labelgen", root)
    assert {"boxcars", "bcs-masks", "speed", "synth"} <= set(names)
    for name, command in names.items():
        assert f"## `labelgen {name}`" in text
        for sub in subcommands(f"labelgen {name}", command):
            assert f"## `labelgen {name} {sub}`" in text
    assert "`--overwrite`" in text


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_files_of_the_project_that_a_page_names_exist(page: Path) -> None:
    names = re.findall(r"`((?:labelgen|detector|tools|tests|data_manifests|docs)/[\w./]*)`", page.read_text("utf-8"))
    assert [name for name in names if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_modules_that_a_page_runs_exist(page: Path) -> None:
    modules = re.findall(r"python -m ((?:labelgen|detector|tools)[\w.]*)", page.read_text("utf-8"))
    paths = [ROOT / module.replace(".", "/") for module in modules]
    assert [path for path in paths if not (path.with_suffix(".py").exists() or path.is_dir())] == []


def test_tasks_of_a_newcomer_name_their_folders() -> None:
    section = (ROOT / "docs/architecture.md").read_text("utf-8").split("## Tasks and where")[1]
    assert sum(line.startswith("| ") for line in section.splitlines()) >= 12  # two lines of the head


def test_shortcuts_are_left_out() -> None:
    assert without_shortcuts({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == {"a": {"b"}, "b": {"c"}, "c": set()}


def test_the_house_is_drawn_from_the_imports() -> None:
    imports = room_imports(read_layers(ROOT / "pyproject.toml"))
    assert {"labelgen.geometry", "labelgen.labels"} <= imports["labelgen.labeling"]
    figure = draw_house(without_shortcuts(imports))
    assert len(figure.axes[0].texts) == 2 * len(imports)
