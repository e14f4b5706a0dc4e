"""Runs the Python examples of the documentation, in order, in a folder of their own."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch

from detector.checkpoint import METADATA_KEY, ModelMetadata
from detector.model.retinanet import build_model
from detector.training.config import PRESETS
from labelgen.choices import Pair
from labelgen.cli.main import main
from labelgen.geometry import Camera

DOCS = Path(__file__).resolve().parents[2] / "docs"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks_of(page: str) -> list[tuple[int, str, str]]:
    """Return line number, language and text of the code blocks of a page."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return [(text.count("\n", 0, match.start()) + 2, match[1], match[2]) for match in BLOCK.finditer(text)]


def run_command(line: str) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(shlex.split(line)[1:])
    assert stopped.value.code == 0, line


def run_page(page: str, names: dict[str, object]) -> int:
    """Run the shell and Python blocks of a page; an error says where in the page it is. Returns how many ran."""
    count = 0
    for line, language, text in blocks_of(page):
        if language == "sh":
            for command in text.splitlines():
                run_command(command)
        elif language == "python":
            # Empty lines before the code make the traceback name the page's own lines.
            exec(compile("\n" * (line - 1) + text, str(DOCS / page), "exec"), names)
            count += 1
    return count


def write_untrained_checkpoint(path: Path) -> None:
    preset = PRESETS["small"]
    model = build_model(preset.model)
    metadata = ModelMetadata("small", Pair.VP2_VP3, (480, 270), preset.model, 10.0, [], {})
    path.parent.mkdir(parents=True)
    torch.save({"state_dict": model.state_dict(), METADATA_KEY: metadata.to_dict()}, path)


def test_the_calibration_of_the_guide_is_a_camera() -> None:
    texts = [text for _, language, text in blocks_of("guides/calibrate.md") if language == "json"]
    assert texts
    for text in texts:
        assert Camera.from_dict(json.loads(text)).scale is not None


@pytest.mark.slow
def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_untrained_checkpoint(tmp_path / "runs" / "small" / "best.ckpt")
    assert run_page("examples.md", {"__name__": "__main__"}) >= 10
    shutil.copytree("shards/examples", "shards/clip")
    for page in ("../README.md", "getting-started/quickstart.md", "reference/shard-format.md"):
        assert run_page(page, {"__name__": "__main__"}) == 1
