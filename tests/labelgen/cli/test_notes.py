"""What commands print beside their result: few lines on the screen, the rest in a file, C libraries counted."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from clips import write_clip

from labelgen.cli.main import main

FOLDERS = 14


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders of shards, each without its index: as many warnings."""
    root = tmp_path_factory.mktemp("notes")
    clip = write_clip(root, 10)
    with pytest.raises(SystemExit) as end:
        main(["bcs-masks", str(clip), "--masks", f"coco:{root / 'masks.json'}", "--every", "5", "--out", f"{root}/0"])
    assert not end.value.code
    (root / "0" / "dataset.json").unlink()
    for number in range(1, FOLDERS):
        shutil.copytree(root / "0", root / str(number))
    return [root / str(number) for number in range(FOLDERS)]


def notes(stderr: str) -> list[str]:
    return [line for line in stderr.splitlines() if line.startswith(("note: ", "warning: "))]


def test_few_lines_are_on_the_screen_and_all_beside_the_output(
    labelgen: Any, folders: list[Path], tmp_path: Path
) -> None:
    done = labelgen("merge", *folders, "--out", "all")
    assert done.returncode == 0, done.stderr
    assert len(notes(done.stderr)) == 10
    assert (
        notes(done.stderr)[-1]
        == "note: 6 more lines like these; all of them are in all.labelgen.log, beside the output"
    )
    first, *lines = (tmp_path / "all.labelgen.log").read_text().splitlines()
    assert first == "warning: 13 shards were there twice and are taken once"
    assert all(str(folder) in line for folder, line in zip(folders, lines, strict=True))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all", "all.labelgen.log"]
    assert labelgen("validate", "all").returncode == 0


def test_without_an_output_there_is_no_file(labelgen: Any, folders: list[Path], tmp_path: Path) -> None:
    done = labelgen("inspect", *folders)
    assert notes(done.stderr)[9:] == ["note: 5 more lines like these; labelgen --verbose shows them"]
    assert len(notes(labelgen("--verbose", "inspect", *folders).stderr)) == FOLDERS
    assert list(tmp_path.iterdir()) == []


def test_an_error_is_the_last_line(labelgen: Any, folders: list[Path], tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "shard-00000.h5").write_bytes(b"none")
    done = labelgen("inspect", *folders, "x")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("labelgen: error: ")


def test_messages_of_image_libraries_are_counted(labelgen_process: Any, tmp_path: Path) -> None:
    """libpng and libjpeg write to the process's standard error, past Python, from any thread."""
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(30):
        suffix = ".jpg" if number % 2 else ".png"
        content = bytearray(cv2.imencode(suffix, rng.integers(0, 255, (90, 160, 3), dtype=np.uint8))[1].tobytes())
        if number >= 10 and number % 2:  # extraneous bytes: read all the same
            content[-2:-2] = bytes(300)
        elif number >= 10:  # a wrong check sum: not read
            content[3000] ^= 0xFF
        (folder / f"{number:02d}{suffix}").write_bytes(content)
    done = labelgen_process("calibrate", "frames", "--out", "c.json")
    assert done.returncode == 2
    assert "libpng error" not in done.stderr.replace("such as: libpng error", "")
    told = [line for line in notes(done.stderr) if "of image libraries" in line]
    assert len(told) == 1
    assert int(told[0].split()[1]) >= 10
    assert "10 images skipped: they cannot be read, such as 10.png: not an image" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("labelgen: error: ")
    assert len(done.stderr.splitlines()) <= 11


def test_other_messages_of_libraries_stay(labelgen_process: Any, capfd: pytest.CaptureFixture[str]) -> None:
    from labelgen.cli.foreign_messages import counted_foreign_messages

    with counted_foreign_messages():
        os.write(2, b"libjpeg turned up\nlibpng error: x\nhalf a line")
    assert capfd.readouterr().err == "libjpeg turned up\nhalf a line\n"
