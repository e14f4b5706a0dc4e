"""Image files that cannot be read: one clear line, whatever is wrong with them; and where a scene's files are."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from labelgen.datasets.scene import read_mask
from labelgen.errors import DataError
from labelgen.media.image_file import decode_image, read_image
from labelgen.media.image_folder import ImageFolder

PICTURE = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _announced(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", b"") + _chunk(b"IEND", b"")


BROKEN = {"empty": b"", "text": b"no picture", "cut": PNG[:1000], "10^10 pixels": _announced(100_000, 100_000)}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_image_is_one_clear_error(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.png"
    path.write_bytes(BROKEN[name])
    for read in (read_image, read_mask):
        with pytest.raises(DataError, match=r"x\.png: not an image") as caught:
            read(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="atlas: not an image"):
        decode_image(np.frombuffer(BROKEN[name], np.uint8), "atlas")
    (tmp_path / "y.png").write_bytes(PNG)
    folder = ImageFolder(tmp_path)
    assert [frame.name for frame in folder.frames()] == ["y.png"]
    assert folder.problems == ["x.png: cannot be read as an image, skipped"]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["none.png", "no\0ne.png", "no\ud800ne.png", "n" * 300])
def test_paths_that_lead_nowhere(tmp_path: Path, name: str) -> None:
    for read in (read_image, read_mask):
        with pytest.raises(DataError, match=r"n.*: .") as caught:
            read(tmp_path / name)
        str(caught.value).encode()
    with pytest.raises(DataError, match=r"^crop 7: "):
        read_image(tmp_path / name, label="crop 7")


def test_flags_decide_what_comes_back(tmp_path: Path) -> None:
    (tmp_path / "é x.png").write_bytes(PNG)
    np.testing.assert_array_equal(read_image(tmp_path / "é x.png"), PICTURE)
    assert read_image(tmp_path / "é x.png", cv2.IMREAD_GRAYSCALE).shape == (40, 50)


def test_opencv_keeps_its_own_log_level(tmp_path: Path) -> None:
    before = cv2.utils.logging.getLogLevel()
    with pytest.raises(DataError):
        decode_image(np.frombuffer(PNG[:1000], np.uint8), "x")
    assert cv2.utils.logging.getLogLevel() == before
