"""What can be checked before PyTorch is imported and before a frame is decoded is checked then."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from clips import write_clip

from labelgen.before_torch import check_device
from labelgen.errors import LabelgenError

CASES = [
    ("speed {clip} --out o --from masks:coco:nowhere", "nowhere: no such file; masks coco:FILE needs"),
    ("speed {clip} --out o --from masks:maskrcnn --weights nowhere", "--weights nowhere: No such file"),
    ("speed {clip} --out o --from masks:maskrcnn --device nonsense", "--device nonsense: unknown"),
    ("speed {clip} --out o --from model:nowhere", "checkpoint nowhere: No such file or directory (option --from)"),
    ("speed {clip} --out o --from detections:nowhere", "detections nowhere: No such file"),
    ("bcs-masks {clip} --out o --masks coco:nowhere", "nowhere: no such file; masks coco:FILE needs"),
    ("bcs-masks {clip} --out o --weights nowhere", "--weights nowhere: No such file"),
    ("bcs-masks {clip} --out o --device nonsense", "--device nonsense: unknown"),
    ("detect nowhere {clip} --out o", "checkpoint nowhere: No such file"),
    ("detect {clip} {clip} --out o --device nonsense", "--device nonsense: unknown"),
    ("test-detector nowhere {clip}", "checkpoint nowhere: No such file"),
    ("export-model nowhere --out o.onnx", "checkpoint nowhere: No such file"),
    ("train nowhere --out o", "nowhere: no such file or folder of shards"),
    ("train {clip} --val nowhere:3 --out o", "nowhere: no such file or folder of shards"),
    ("train {clip} --weights nowhere --out o", "--weights nowhere: No such file"),
    ("train {clip} --device nonsense --out o", "--device nonsense: unknown"),
    ("train {clip} --json no/x.json --out o", "--json no/x.json: its folder is missing"),
]
# As `python -m labelgen`, but for what may be imported and opened.
PROGRAM = """
import sys
class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "torchvision", "lightning"):
            raise AssertionError(f"{name} is imported")
sys.meta_path.insert(0, Refused())
import av
av.open = None
from labelgen.cli.main import main
from labelgen.media import video_reader
video_reader.VideoFile = None
import shlex
for line in sys.stdin.read().splitlines():
    try:
        main(shlex.split(line))
    except SystemExit as end:
        print(f"exit code {end.code}", file=sys.stderr)
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> list[list[str]]:
    """The lines that each of the cases prints, of one process that has neither PyTorch nor a video reader."""
    folder = tmp_path_factory.mktemp("early")
    clip = write_clip(folder, 3)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input="\n".join(line.format(clip=clip) for line, _ in CASES),
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert not list(folder.glob("o*"))
    parts: list[list[str]] = [[]]
    for line in done.stderr.splitlines():
        parts[-1].append(line)
        if line.startswith("exit code "):
            parts.append([])
    assert len(parts) == len(CASES) + 1, done.stderr
    return parts


@pytest.mark.parametrize("number", range(len(CASES)), ids=[line.split(" --out")[0] for line, _ in CASES])
def test_a_wrong_input_is_refused_at_once(told: list[list[str]], number: int) -> None:
    *_, error, code = told[number]
    assert code == "exit code 2"
    assert error.startswith(f"labelgen: error: {CASES[number][1]}")


@pytest.mark.parametrize("name", ["gpu:x", "cuda:-1", "tpu", "mps:0", "cpu:0"])
def test_names_that_are_no_device(name: str) -> None:
    with pytest.raises(LabelgenError, match="unknown; use one of auto, cpu"):
        check_device(name)


@pytest.mark.skipif(sys.platform == "darwin", reason="a machine that has it")
def test_a_device_of_another_machine() -> None:
    with pytest.raises(LabelgenError, match="this machine has no such GPU"):
        check_device("mps")


def test_good_names_pass() -> None:
    for name in (None, "auto", " CPU "):
        check_device(name)
