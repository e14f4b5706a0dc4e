"""Messages of the library name parameters; only the command line speaks of options."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

from labelgen.cli.main import app
from labelgen.cli.notes import name_options
from labelgen.errors import LabelgenError

ROOT = Path(__file__).resolve().parents[2]
# A file that is a program of its own has options, too.
PROGRAM = 'if __name__ == "__main__":'
FILES = [
    path
    for room in ("labelgen", "detector")
    for path in (ROOT / room).rglob("*.py")
    if "cli" not in path.parts and PROGRAM not in path.read_text(encoding="utf-8")
]
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def _docstrings(tree: ast.AST) -> set[int]:
    owners = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    bodies = [node.body for node in ast.walk(tree) if isinstance(node, owners) and node.body]
    return {id(body[0].value) for body in bodies if isinstance(body[0], ast.Expr)}


def test_no_message_of_the_library_names_an_option() -> None:
    assert len(FILES) > 100
    wrong = []
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = _docstrings(tree)
        wrong += [
            f"{path.relative_to(ROOT)}:{node.lineno}: {node.value}"
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
            if id(node) not in docstrings and OPTION.search(node.value)
        ]
    assert not wrong, "\n".join(wrong)


def _commands() -> dict[str, list[Any]]:
    """Commands by the function that each of them is, `module:name`; those of a group by their own names."""
    group: Any = typer.main.get_command(app)
    found: dict[str, list[Any]] = {}
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        for one in getattr(command, "commands", {"": command}).values():
            function = inspect.unwrap(one.callback)
            found.setdefault(f"{Path(inspect.getfile(function)).stem}:{function.__name__}", []).append(one)
    return found


def _options(command: Any) -> set[str]:
    return {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}


def _named_options(function: ast.AST) -> set[str]:
    """Options in the texts of a function's body; its signature declares options, and names none."""
    texts = (
        node.value
        for part in getattr(function, "body", [])
        for node in ast.walk(part)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    docstring = ast.get_docstring(function, clean=False) if isinstance(function, ast.FunctionDef) else None
    return {option for text in texts if text != docstring for option in OPTION.findall(text)}


def _functions(path: Path) -> dict[str, ast.FunctionDef]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def _called(function: ast.FunctionDef) -> set[str]:
    return {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}


def test_every_option_that_a_command_names_is_its_own() -> None:
    """Also through the functions that commands share: each is followed to the commands that call it."""
    files = sorted((ROOT / "labelgen" / "cli").glob("*.py"))
    shared = {
        name: node for path in files if path.stem in ("options", "printing") for name, node in _functions(path).items()
    }
    wrong, checked = [], set()
    for place, commands in _commands().items():
        stem, name = place.split(":")
        functions = {**shared, **_functions(ROOT / "labelgen" / "cli" / f"{stem}.py")}
        reached, new = set(), {name}
        while new:
            reached |= new
            new = {other for one in new for other in _called(functions[one]) if other in functions} - reached
        named = set().union(*(_named_options(functions[one]) for one in reached))
        checked |= named
        wrong += [
            f"{command.name} names {sorted(named - _options(command))}"
            for command in commands
            if command.name != "demo"  # it calls other commands, with options of theirs
            if named - _options(command)
        ]
    assert not wrong
    assert {"--json", "--overwrite", "--out", "--from", "--pair", "--size", "--resume"} <= checked


def test_parameters_in_notes_become_options_of_the_command() -> None:
    text = "with scale_masks they are scaled; first_frame 1; for exact results set deinterlace"
    assert name_options(text, {"--scale-masks", "--deinterlace"}) == (
        "with --scale-masks they are scaled; first_frame 1; for exact results set --deinterlace"
    )
    assert name_options(text, ()) == text


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("boxcars", "--root", "none", "--size", "9x9"), "--size 9x9: unknown size"),
        (("speed", "none.mp4", "--out", "out", "--from", "x"), "--from x: unknown"),
        (("rectify", "none.mp4", "--out", "p.png"), "none.mp4: no such file or folder"),
        (("bcs-masks", "none.mp4", "--masks", "foo"), "--masks foo: unknown mask source"),
        (
            ("speed", "none.mp4", "--out", "out", "--from", "masks:foo"),
            "masks foo: unknown mask source; use one of maskrcnn, background, coco:FILE, onnx:FILE, gated:maskrcnn, "
            "gated:coco:FILE, gated:onnx:FILE (option --from)",
        ),
        (
            ("synth", "session", "--out", "out", "--replay"),
            "there is no recorded traffic to re-enact; name a real session as the scene (options --replay, --scene)",
        ),
        (("boxcars", "--root", "none", "--pair", " vp1-VP2 ", "--out", "out"), "--root none: "),
        (("spee",), "No such command 'spee'. Did you mean 'speed'?"),
    ],
)
def test_the_command_line_names_the_option(labelgen, arguments: tuple[str, ...], line: str) -> None:
    done = labelgen(*arguments)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"labelgen: error: {line}")


@pytest.mark.slow
def test_a_parameter_with_a_unit_has_its_option(labelgen, real_data: Path) -> None:
    scene = real_data / "brnocompspeed" / "dataset" / "session0_left"
    done = labelgen("synth", "session", "--out", "out", "--scene", scene, "--replay", "--start", "1e9", "--no-video")
    assert done.returncode == 2
    assert "(option --start)" in done.stderr


@pytest.mark.parametrize("arguments", [(), ("synth",)])
def test_without_arguments_the_help_is_shown(labelgen, arguments: tuple[str, ...]) -> None:
    done = labelgen(*arguments)
    assert done.returncode == 2
    assert "Usage: labelgen" in done.stdout + done.stderr
    assert "--install-completion" not in done.stdout + done.stderr
    assert "error" not in done.stderr


def test_an_error_keeps_its_parameters() -> None:
    assert LabelgenError("x").parameters == ()
    assert LabelgenError("x", parameter="a").parameters == ("a",)
    assert LabelgenError("x", parameter=("a", "b")).parameters == ("a", "b")
