"""Messages of the library name parameters; only the command line speaks of options."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

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
