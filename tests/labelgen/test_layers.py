"""Arrows point down: tools -> detector -> labelgen.shards -> labelgen.geometry; nobody reaches up to the renderer."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def imported(folder: str) -> set[str]:
    """Modules that the files of a folder import, wherever in the file that is."""
    found: set[str] = set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {name.name for name in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module)
    return found


@pytest.mark.parametrize(
    ("folder", "above"),
    [
        ("labelgen/geometry", ["labelgen.shards", "labelgen.masks", "labelgen.sources", "labelgen.calibrate"]),
        ("labelgen/shards", ["labelgen.generate", "labelgen.masks", "labelgen.sources", "labelgen.calibrate"]),
        ("labelgen/masks", ["labelgen.generate", "labelgen.calibrate", "labelgen.commands"]),
        ("labelgen/calibrate", ["labelgen.synth", "labelgen.generate", "labelgen.commands"]),
        ("labelgen/synth", ["labelgen.generate", "labelgen.commands"]),
        ("detector", ["tools", "labelgen.commands"]),
    ],
)
def test_nothing_reaches_up(folder: str, above: list[str]) -> None:
    modules = imported(folder)
    assert len(modules) > 5
    wrong = {m for m in modules for up in above if m == up or m.startswith(f"{up}.")}
    assert not wrong
    if folder != "detector":
        assert not {m for m in modules if m.split(".")[0] in ("detector", "tools")}
