"""Files that grow by records: readable after every record, and after one that did not fit on the disk."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from detector.speed.append_file import AppendFile
from labelgen.errors import OutputError

JSON = {"head": '{"cars": [\n', "separator": ",\n", "tail": "\n]}\n"}


def test_whole_after_every_record(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    with AppendFile(path, **JSON) as file:
        assert json.loads(path.read_text()) == {"cars": []}
        for number in range(5):
            file.add(json.dumps({"id": number, "text": "x" * number * 7}))
            assert [car["id"] for car in json.loads(path.read_text())["cars"]] == list(range(number + 1))
            assert file.count == number + 1


def test_an_older_file_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("x" * 1000)
    with AppendFile(path, head="a,b\n") as file:
        file.add("1,2\n")
    assert path.read_text() == "a,b\n1,2\n"


def test_what_cannot_be_made_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        AppendFile(tmp_path / "no" / "such" / "folder.csv")


def test_a_full_disk_keeps_what_was_there(tmp_path: Path) -> None:
    """A limit on the file size simulates a full disk: writing fails in the middle of a record."""
    path = tmp_path / "r.json"
    code = f"""
import json, resource
from pathlib import Path
from detector.speed.append_file import AppendFile
from labelgen.errors import OutputError
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
with AppendFile(Path({str(path)!r}), **{JSON!r}) as file:
    try:
        for number in range(100):
            file.add(json.dumps({{"id": number, "text": "x" * 60}}))
    except OutputError as error:
        print(file.count, error)
"""
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    count, message = done.stdout.split(" ", 1)
    assert "file too large" in message
    assert [car["id"] for car in json.loads(path.read_text())["cars"]] == list(range(int(count)))
    assert int(count) > 5
    assert path.stat().st_size <= 1000
