"""The demo refuses a folder that holds something."""

from __future__ import annotations

from pathlib import Path

import pytest

from labelgen.cli.demo import demo
from labelgen.errors import OutputError


def test_a_folder_that_is_not_empty_is_kept(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match="not empty") as error:
        demo(tmp_path)
    assert error.value.parameters
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
