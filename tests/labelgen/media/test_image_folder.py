"""Image files that cannot be read: one clear line, whatever is wrong with them; and where a scene's files are."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from labelgen.datasets.scene import read_mask
from labelgen.errors import DataError, LabelgenError
from labelgen.media.image_file import decode_image, read_image
from labelgen.media.image_folder import ImageFolder
from labelgen.media.image_header import image_size

PICTURE = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _announced(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", b"") + _chunk(b"IEND", b"")


BROKEN = {"empty": b"", "text": b"no picture", "cut": PNG[:1000]}


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
    assert folder.problems == ["x.png: not an image; skipped"]
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


def _jpeg(width: int, height: int) -> bytes:
    frame = struct.pack(">BHHB", 8, height, width, 1) + bytes([1, 0x11, 0])
    return b"\xff\xd8\xff\xe0\x00\x04\xff\xc0\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def _bmp(width: int, height: int) -> bytes:
    return b"BM" + bytes(12) + struct.pack("<IiiHH", 40, width, -height, 1, 24) + bytes(24)


def _tiff(width: int, height: int) -> bytes:
    return b"MM\0*" + struct.pack(">IHHHIIHHII", 8, 2, 256, 4, 1, width, 257, 4, 1, height) + bytes(4)


BOMBS = {
    "png": _announced(20_000, 20_000),
    "jpg": _jpeg(20_000, 20_000),
    "bmp": _bmp(20_000, 20_000),
    "tif": _tiff(20_000, 20_000),
    "webp": b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + (19_999).to_bytes(3, "little") * 2 + bytes(20),
    "pgm": b"P5 # a comment\n20000 20000\n255\n",
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_picture_of_very_many_pixels_is_refused_before_it_is_decoded(tmp_path: Path, kind: str) -> None:
    (tmp_path / f"a.{kind}").write_bytes(BOMBS[kind])
    (tmp_path / "b.png").write_bytes(PNG)
    with pytest.raises(DataError, match=r"20000x20000 px are too many; images of up to 100 megapixels.*LABELGEN_MAX"):
        read_image(tmp_path / f"a.{kind}")
    folder = ImageFolder(tmp_path)
    assert folder.size_wh == (50, 40)
    assert [frame.name for frame in folder.frames()] == ["b.png"]
    assert len(folder.problems) == 1
    assert "20000x20000 px are too many" in folder.problems[0]


def test_the_limit_of_pixels_can_be_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "b.png").write_bytes(PNG)
    monkeypatch.setenv("LABELGEN_MAX_PIXELS", "1999")
    with pytest.raises(DataError, match=r"50x40 px are too many; images of up to 0\.001999 megapixels"):
        read_image(tmp_path / "b.png")
    monkeypatch.setenv("LABELGEN_MAX_PIXELS", "2000")
    assert read_image(tmp_path / "b.png").shape == (40, 50, 3)
    monkeypatch.setenv("LABELGEN_MAX_PIXELS", "many")
    with pytest.raises(LabelgenError, match="LABELGEN_MAX_PIXELS=many: expected a number of pixels"):
        read_image(tmp_path / "b.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm", ".pgm", ".gif"])
def test_the_header_tells_the_size_of_what_is_written(suffix: str) -> None:
    encoded = cv2.imencode(suffix, PICTURE if suffix != ".pgm" else PICTURE[..., 0])[1]
    assert image_size(memoryview(encoded)) == (50, 40)
    assert decode_image(encoded, "x").shape == (40, 50, 3)
    with pytest.raises(DataError, match="x: its image is 50x40 px, expected 50x41"):
        decode_image(encoded, "x", expected_wh=(50, 41))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_a_named_pipe_is_no_image(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(DataError, match=r"pipe\.png: a pipe or device, not an image"):
        read_image(tmp_path / "pipe.png")
