"""Detections as JSON lines: written, read back, and refused where they are damaged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from speed_scenes import Drive, exact_detections, make_view

from detector.speed.detection_file import DetectionFile, detections_head
from detector.speed.variant import Variant
from labelgen.errors import DataError
from labelgen.geometry import Pair

DRIVES = [Drive(70.0, 38.0, 2.0), Drive(60.0, 34.0, -3.0)]


def write(path: Path, variant: Variant, pair: Pair = Pair.VP2_VP3, change: dict[str, Any] | None = None) -> list[Any]:
    view = make_view(variant, pair)
    found = [exact_detections(view, DRIVES if n % 3 else [], n, n / 50) for n in range(12)]
    head = {**json.loads(detections_head(view, 50.0)), **(change or {})}
    path.write_text("\n".join([json.dumps(head), *(json.dumps(f.to_dict()) for f in found)]) + "\n")
    return found


@pytest.mark.parametrize("pair", list(Pair))
@pytest.mark.parametrize("variant", list(Variant))
def test_what_is_written_is_read(tmp_path: Path, variant: Variant, pair: Pair) -> None:
    path = tmp_path / "d.jsonl"
    before = write(path, variant, pair)
    file = DetectionFile.open(path)
    assert (file.variant, file.frame_wh, file.fps) == (variant, (1920, 1080), 50.0)
    after = list(file.frames(file.view(make_view(variant, pair).camera)))
    assert len(after) == len(before)
    for a, b in zip(after, before, strict=True):
        assert (a.frame, len(a)) == (b.frame, len(b))
        assert a.time_s == pytest.approx(b.time_s)
        np.testing.assert_allclose(a.contact_points_px, b.contact_points_px, atol=2e-3)
        np.testing.assert_allclose(a.vertices_px, b.vertices_px, atol=5e-2)


def test_times_come_from_the_rate_where_lines_have_none(tmp_path: Path) -> None:
    path = tmp_path / "d.jsonl"
    write(path, Variant.ORIG2D)
    lines = [json.loads(text) for text in path.read_text().splitlines()]
    bare = [lines[0], *({k: v for k, v in line.items() if k in ("frame", "boxes")} for line in lines[1:])]
    path.write_text("\n".join(map(json.dumps, bare)))
    file = DetectionFile.open(path)
    found = list(file.frames(file.view(make_view(Variant.ORIG2D).camera)))
    assert [f.time_s for f in found] == pytest.approx([n / 50 for n in range(12)])
    assert found[1].scores.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "coco"}, "first line is not that of a labelgen-detections file"),
        ({"version": 2}, "of version 1"),
        ({"variant": "4d"}, "damaged.*unknown variant"),
        ({"frame_wh": [1]}, "damaged"),
        ({"fps": 10**400}, "damaged"),
        ({"frame_wh": [1920, 0]}, "damaged"),
        ({"frame_wh": [float("inf"), 1]}, "damaged"),
        ({"fps": -3}, "damaged"),
        ({"rectification": None}, "do not go together"),
        ({"rectification": {"pair": "VP2-VP3"}}, "damaged"),
    ],
)
def test_damaged_heads(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = tmp_path / "d.jsonl"
    write(path, Variant.TRANSFORM3D, change=change)
    with pytest.raises(DataError, match=message):
        DetectionFile.open(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 3: not JSON"),
        ("[]", "line 3: expected a JSON object"),
        ('{"boxes": []}', "line 3: damaged.*frame"),
        ('{"frame": 1.5, "boxes": []}', "line 3: damaged.*frame"),
        ('{"frame": 9, "boxes": [[1, 2, 3]]}', "line 3: damaged"),
        ('{"frame": 9, "boxes": [[1, 2, 3, 4]], "cc": [0.5, 0.5]}', "line 3: damaged.*cc: expected shape"),
        ('{"frame": 9, "boxes": [["a", 2, 3, 4]]}', "line 3: damaged"),
        ('{"frame": 9, "time_s": 1e27, "boxes": []}', "line 3: damaged.*time_s"),
        ('{"frame": 9, "time_s": -1e27, "boxes": []}', "line 3: damaged.*time_s"),
        ('{"frame": 9000000000000000000000, "boxes": []}', "line 3: damaged.*frame"),
        ('{"frame": 0, "boxes": []}', "line 3: frame 0 after frame 0; sort the lines"),
    ],
)
def test_damaged_lines_are_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "d.jsonl"
    write(path, Variant.TRANSFORM3D)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], line]))
    file = DetectionFile.open(path)
    with pytest.raises(DataError, match=message):
        list(file.frames(file.view(make_view(Variant.TRANSFORM3D).camera)))


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe\x00", b"not json\n"])
def test_files_that_are_none(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "d.jsonl"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match="detections"):
        DetectionFile.open(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b'{"frame": 9, "boxes": [], "note": "\xff"}', "line 14: not UTF-8 text"),
        (b'{"frame": 99, "time_s": 1' + b"0" * 400 + b', "boxes": []}', "line 14: damaged"),
        (b'{"frame": 99, "boxes": [[1, 2, 3, 1' + b"0" * 400 + b"]]}", "line 14: damaged"),
    ],
)
def test_a_late_line_that_is_no_text_or_too_large(tmp_path: Path, line: bytes, message: str) -> None:
    path = tmp_path / "d.jsonl"
    write(path, Variant.TRANSFORM3D)
    path.write_bytes(path.read_bytes() + line + b"\n")
    file = DetectionFile.open(path)
    with pytest.raises(DataError, match=message):
        list(file.frames(file.view(make_view(Variant.TRANSFORM3D).camera)))
