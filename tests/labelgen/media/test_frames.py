"""Frames from videos and folders of images, whatever state they are in."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.media.open_frames import open_frames

RATE = 25
REAL = os.environ.get("LABELGEN_REAL_DATA")


def picture(number: int, size_wh: tuple[int, int] = (64, 48)) -> np.ndarray:
    """Draw a frame whose grey level encodes its number and whose top left quarter is bright."""
    image = np.full((size_wh[1], size_wh[0], 3), min(20 + 7 * number, 250), dtype=np.uint8)
    image[: size_wh[1] // 2, : size_wh[0] // 2] = 220
    return image


def write_video(
    path: Path,
    count: int = 30,
    *,
    pts: Sequence[int] | None = None,
    rotation: int = 0,
    codec: str = "mpeg4",
    size_wh: tuple[int, int] = (64, 48),
) -> Path:
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=RATE)
        stream.width, stream.height = size_wh
        stream.pix_fmt = "yuv420p"
        tick = Fraction(1, RATE) if pts is None else Fraction(1, 1000)
        stream.codec_context.time_base = tick
        stream.codec_context.options = {"g": "5"}
        stream.bit_rate = 2_000_000
        if rotation:
            stream.set_display_rotation(rotation)
        for i in range(count):
            frame = av.VideoFrame.from_ndarray(picture(i, size_wh), format="bgr24")
            frame.pts = i if pts is None else pts[i]
            frame.time_base = tick
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def level(image: np.ndarray) -> float:
    """Decode the frame number from the picture's bottom right."""
    return (float(image[-8:, -8:].mean()) - 20) / 7


@pytest.mark.parametrize("suffix", ["mp4", "avi", "mkv"])
def test_reads_every_frame_in_order_with_its_time(tmp_path: Path, suffix: str) -> None:
    source = open_frames(write_video(tmp_path / f"road.{suffix}"))
    frames = list(source.frames())
    assert source.name == "road"
    assert source.size_wh == (64, 48)
    assert source.fps == pytest.approx(RATE, rel=0.01)
    assert source.frame_count == 30
    assert [f.number for f in frames] == list(range(30))
    np.testing.assert_allclose([f.time_s for f in frames], np.arange(30) / RATE, atol=2e-3)
    np.testing.assert_allclose([level(f.image) for f in frames], np.arange(30), atol=0.49)
    assert frames[0].image.shape == (48, 64, 3)
    assert frames[0].image.dtype == np.uint8
    assert source.problems == []
    assert (source.is_live, source.failure) == (False, None)


def test_gives_only_wanted_frames_and_can_be_read_twice(tmp_path: Path) -> None:
    source = open_frames(write_video(tmp_path / "road.mp4"))
    first = next(iter(source.frames()))
    assert first.number == 0
    for _ in range(2):
        assert [f.number for f in source.frames(lambda i: i % 7 == 3)] == [3, 10, 17, 24]
    assert [round(level(f.image)) for f in source.frames(lambda i: i == 17)] == [17]


def test_variable_frame_rate_keeps_each_frames_own_time(tmp_path: Path) -> None:
    pts = np.cumsum([1000, 40, 40, 250, 33, 500, 40, 10, 90, 40]).tolist()
    source = open_frames(write_video(tmp_path / "vfr.mkv", 10, pts=pts))
    times = [f.time_s for f in source.frames()]
    np.testing.assert_allclose(times, (np.array(pts) - pts[0]) / 1000, atol=2e-3)


@pytest.mark.parametrize("rotation", [90, 180, 270])
def test_honours_rotation(tmp_path: Path, rotation: int) -> None:
    source = open_frames(write_video(tmp_path / "turned.mp4", 5, rotation=rotation))
    image = next(iter(source.frames())).image
    expected = np.rot90(picture(0), k=rotation // 90)
    assert source.size_wh == (expected.shape[1], expected.shape[0])
    assert image.shape == expected.shape
    assert np.abs(image.astype(int) - expected).mean() < 12


def test_truncated_video_gives_what_is_there(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.avi", 50, size_wh=(160, 120)).read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) * 8 // 10])
    source = open_frames(tmp_path / "cut.avi")
    count = len(list(source.frames()))
    assert 0 < count < 50
    assert source.frame_count == 50
    assert f"ended after {count} of 50 announced frames" in source.problems[0]


def test_damaged_video_reports_and_reads_on(tmp_path: Path) -> None:
    data = bytearray(write_video(tmp_path / "whole.avi", 50, size_wh=(160, 120)).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 1500] = bytes(np.random.default_rng(0).integers(0, 256, 1500, dtype=np.uint8))
    (tmp_path / "damaged.avi").write_bytes(data)
    source = open_frames(tmp_path / "damaged.avi")
    numbers = [f.number for f in source.frames()]
    assert len(numbers) > 25
    assert source.problems
    assert all("\n" not in line for line in source.problems)


def test_skips_frames_of_another_size(tmp_path: Path) -> None:
    # Elementary MPEG-2 streams may be joined byte by byte, each beginning with its own sequence header.
    small = write_video(tmp_path / "a.m2v", 10, codec="mpeg2video").read_bytes()
    large = write_video(tmp_path / "b.m2v", 7, codec="mpeg2video", size_wh=(96, 64)).read_bytes()
    (tmp_path / "joined.m2v").write_bytes(small + large)
    source = open_frames(tmp_path / "joined.m2v")
    frames = list(source.frames())
    assert {f.image.shape for f in frames} == {(48, 64, 3)}
    assert len(frames) >= 9
    assert any("of another size skipped" in p and "96x64 instead of 64x48" in p for p in source.problems)


def audio_only(path: Path) -> None:
    with av.open(str(path), "w") as out:
        stream = out.add_stream("pcm_s16le", rate=8000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 8000), dtype=np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        out.mux(stream.encode(frame))
        out.mux(stream.encode(None))


PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\nhttp://127.0.0.1:1/x.ts\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.mp4", b"", "empty"),
        ("text.txt", b"some words\n" * 400, "not a video"),
        ("noise.avi", np.random.default_rng(1).bytes(50_000), "not a video"),
        ("list.m3u8", PLAYLIST, "not a video"),
    ],
)
def test_refuses_what_is_no_video(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        open_frames(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refuses_missing_and_audio_only_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        open_frames(tmp_path / "nothing.mp4")
    audio_only(tmp_path / "sound.wav")
    with pytest.raises(DataError, match="no video stream"):
        open_frames(tmp_path / "sound.wav")


def test_headers_without_frames_are_refused(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.avi").read_bytes()
    (tmp_path / "head.avi").write_bytes(whole[: whole.find(b"movi") + 4])
    with pytest.raises(DataError, match=r"no frame|not a video"):
        open_frames(tmp_path / "head.avi")


def test_colon_in_a_path_is_no_protocol(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.avi", 3).rename(tmp_path / "tcp:cam 12:30.avi")
    assert len(list(open_frames(path).frames())) == 3


SCRIPT = """
import sys
from labelgen.media.open_frames import open_frames
source = open_frames(sys.argv[1])
frames = list(source.frames())
print(len(frames), *source.size_wh)
"""


def run(path: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", SCRIPT, str(path)], capture_output=True, text=True, check=False)


def test_ffmpegs_own_messages_stay_silent(tmp_path: Path) -> None:
    data = bytearray(write_video(tmp_path / "whole.avi", 50, size_wh=(160, 120)).read_bytes())
    data[len(data) // 2 : len(data) // 2 + 2000] = b"\xff" * 2000
    (tmp_path / "damaged.avi").write_bytes(data)
    done = run(tmp_path / "damaged.avi")
    assert done.returncode == 0
    assert done.stderr == ""


@pytest.mark.skipif(not REAL, reason="LABELGEN_REAL_DATA is not set")
def test_survives_the_file_that_kills_opencv() -> None:
    assert REAL is not None
    done = run(Path(REAL) / "videos" / "odd_rawvideo_48x48.avi")
    assert (done.returncode, done.stdout.split()) == (0, ["51", "48", "48"])


@pytest.mark.skipif(not REAL, reason="LABELGEN_REAL_DATA is not set")
@pytest.mark.parametrize(
    ("name", "count", "last_s"),
    [("city_road_640x360.mp4", 1190, 47.56), ("freeway_320x240.avi", 500, 499 * 1000 / 14999)],
)
def test_real_videos(name: str, count: int, last_s: float) -> None:
    assert REAL is not None
    source = open_frames(Path(REAL) / "videos" / name)
    frames = list(source.frames(lambda i: i in (0, count - 1)))
    assert [f.number for f in frames] == [0, count - 1]
    assert [f.time_s for f in frames] == pytest.approx([0, last_s])
    assert source.frame_count == count
    assert source.problems == []
    assert (source.is_live, source.failure) == (False, None)


# -- folders of images ------------------------------------------------------------------------------


def test_folder_of_images_in_natural_order(tmp_path: Path) -> None:
    for i, name in enumerate(["img1.png", "img2.PNG", "img10.jpg", "img11.bmp"]):
        (tmp_path / name).write_bytes(cv2.imencode(Path(name).suffix.lower(), picture(i))[1].tobytes())
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / ".hidden.png").write_bytes(b"x")
    source = open_frames(tmp_path)
    frames = list(source.frames())
    assert [f.name for f in frames] == ["img1.png", "img2.PNG", "img10.jpg", "img11.bmp"]
    assert [round(level(f.image)) for f in frames] == [0, 1, 2, 3]
    assert all(np.isnan(f.time_s) for f in frames)
    assert (source.frame_count, source.fps, source.size_wh) == (4, None, (64, 48))
    assert [f.number for f in source.frames(lambda i: i % 2 == 1)] == [1, 3]


def test_folder_lists_what_it_skips(tmp_path: Path) -> None:
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture(i))
    (tmp_path / "0.png").write_bytes(b"broken")
    (tmp_path / "2.png").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "3.png"), picture(3, (32, 32)))
    source = open_frames(tmp_path)
    assert [f.number for f in source.frames()] == [1]
    assert source.problems == [
        "2 images skipped: they cannot be read, such as 0.png: not an image",
        "3.png: 32x32 px instead of the first image's 64x48; skipped",
    ]


def test_folder_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no images"):
        open_frames(tmp_path)
    (tmp_path / "a.png").write_bytes(b"nothing")
    with pytest.raises(DataError, match="none of its 1 image files"):
        open_frames(tmp_path)
