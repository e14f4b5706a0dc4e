"""Times of files: with stamps, with a nominal rate, with neither; several streams; files without their end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.media.open_frames import open_frames
from labelgen.media.timed_frames import TimedFrames
from labelgen.media.video_reader import VideoFile
from labelgen.media.video_writer import VideoWriter

MS = Fraction(1, 1000)
COUNT = 40


def write(
    path: Path,
    *,
    rate: int = 10,
    codec: str = "mpeg4",
    kind: str | None = None,
    stamps_ms: Sequence[int] | None = None,
    late_s: Callable[[int], float] = lambda number: 0.0,
    size_wh: tuple[int, int] = (64, 48),
    options: dict[str, str] | None = None,
    count: int = COUNT,
    prepare: Callable[[Any], None] = lambda stream: None,
) -> Path:
    """Frames whose grey level is 5 times their number, 10 per second."""
    with av.open(f"file:{path}", "w", format=kind) as container:
        stream: Any = container.add_stream(codec, rate=rate, options={"qmin": "2", "qmax": "3", **(options or {})})
        stream.width, stream.height = size_wh
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if stamps_ms is not None:
            stream.codec_context.time_base = MS
        prepare(stream)
        packets = []
        for number in range(count):
            image = np.full((size_wh[1], size_wh[0], 3), 5 * number, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format=stream.pix_fmt)
            frame.pts = number if stamps_ms is None else stamps_ms[number]
            frame.time_base = Fraction(1, rate) if stamps_ms is None else MS
            packets += stream.encode(frame)
        for number, packet in enumerate([*packets, *stream.encode(None)]):
            packet.pts += round(late_s(number) / packet.time_base)
            container.mux(packet)
    return path


def times(source: Any) -> list[float]:
    frames = list(source.frames())
    assert [f.image.mean() / 5 for f in frames] == pytest.approx([f.number for f in frames], abs=0.9)
    return [f.time_s for f in frames]


TRUE = np.arange(COUNT) / 10
RAW = [
    ("a.h264", "libx264", "h264", {"bf": "2"}),
    ("a.mjpeg", "mjpeg", "mjpeg", {}),
    ("a.m4v", "mpeg4", "m4v", {}),
    ("a.m2v", "mpeg2video", "mpeg2video", {}),
]


@pytest.mark.parametrize(("name", "codec", "kind", "options"), RAW)
def test_raw_streams_have_the_given_rate_or_none(
    tmp_path: Path, name: str, codec: str, kind: str, options: dict[str, str]
) -> None:
    path = write(tmp_path / name, rate=25, codec=codec, kind=kind, options=options)
    untimed = open_frames(path)
    assert (untimed.fps, untimed.untimed) == (None, "its frames have no time stamps")
    assert np.isnan([f.time_s for f in untimed.frames()]).all()
    with pytest.raises(DataError, match="no time stamps, so there are no speeds; give fps") as caught:
        list(TimedFrames(untimed).frames())
    assert caught.value.parameters == ("fps",)
    given = open_frames(path, fps=10)
    assert times(given) == pytest.approx(TRUE)
    assert (given.fps, given.untimed) == (10, "")
    assert given.notes == ["its frames have no time stamps; timed at the given 10 frames per second"]


@pytest.mark.parametrize(("rate", "trusted"), [(10, True), (25, True), (600, False)])
def test_the_rate_of_an_avi_file(tmp_path: Path, rate: int, trusted: bool) -> None:
    path = write(tmp_path / "a.avi", rate=rate)
    source = open_frames(path)
    assert source.fps == (rate if trusted else None)
    if trusted:
        assert times(source) == pytest.approx(TRUE * 10 / rate)
    else:
        assert "its header says 600 frames per second, which cannot be" in source.untimed
    given = open_frames(path, fps=10)
    assert times(given) == pytest.approx(TRUE)
    assert given.fps == 10
    said = [] if rate == 10 else [f"its header says {rate} frames per second; timed at the given 10"]
    assert given.notes == said


def test_avi_files_with_frames_out_of_order(tmp_path: Path) -> None:
    source = open_frames(write(tmp_path / "a.avi", codec="libx264", options={"bf": "2"}))
    assert times(source) == pytest.approx(TRUE)
    assert source.problems == []


@pytest.mark.parametrize("fps", [None, 10, 25])
def test_stamps_come_before_rates(tmp_path: Path, fps: float | None) -> None:
    path = write(tmp_path / "a.mkv", rate=1000, codec="libx264", stamps_ms=[100 * n for n in range(COUNT)])
    source = open_frames(path, fps=fps)
    assert times(source) == pytest.approx(TRUE)
    assert source.fps == pytest.approx(10)
    assert source.frame_count == pytest.approx(COUNT, abs=1)
    assert not source.count_is_exact
    assert source.problems == []
    word = "the given 25 is not used" if fps == 25 else "its header says 1000 frames per second"
    assert any(word in note for note in source.notes)


def test_stamps_that_cannot_be(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mkv", codec="libx264", stamps_ms=list(range(COUNT)), options={"bf": "0"})
    assert "time stamps cannot be" in open_frames(path).untimed
    assert times(open_frames(path, fps=10)) == pytest.approx(TRUE)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
@pytest.mark.parametrize("late_s", [0.3, 3600.0])
def test_a_single_stamp_out_of_line(tmp_path: Path, name: str, late_s: float) -> None:
    path = write(
        tmp_path / name, codec="libx264", options={"bf": "0"}, late_s=lambda n: late_s if n == 20 else 0,
        stamps_ms=[100 * n for n in range(COUNT)],
    )  # fmt: skip
    source = open_frames(path)
    assert times(source) == pytest.approx(TRUE, abs=2e-3)
    [problem] = source.problems
    assert "1 time stamp missing or out of line" in problem
    assert "first: frame 20" in problem


@pytest.mark.parametrize("lengths", [(20, 20), (5, 35), (35, 5)])
def test_recordings_put_together(tmp_path: Path, lengths: tuple[int, int]) -> None:
    joined = b""
    for part, count in enumerate(lengths):
        joined += write(
            tmp_path / f"{part}.ts", codec="libx264", kind="mpegts", count=count, options={"tune": "zerolatency"}
        ).read_bytes()  # fmt: skip
    (tmp_path / "joined.ts").write_bytes(joined)
    source = open_frames(tmp_path / "joined.ts")
    found = [f.time_s for f in source.frames()]
    assert len(found) >= COUNT - 2
    assert np.diff(found) == pytest.approx(0.1, abs=0.011)
    assert any("the clock jumped back 1 time" in problem for problem in source.problems)
    # Skipping goes on across the place as well.
    wanted = [0.0]
    lazy = []
    for frame in source.frames(lambda number: True, lambda: wanted[0]):
        lazy.append(frame.number)
        wanted[0] = max(wanted[0], frame.time_s)
    assert lazy[-1] == len(found) - 1


def test_a_duration_counts_what_is_shown(tmp_path: Path) -> None:
    stamps = [100 * n + (3_600_000 if n >= 20 else 0) for n in range(COUNT)]
    source = open_frames(write(tmp_path / "a.mkv", codec="libx264", stamps_ms=stamps))
    timed = list(TimedFrames(source, duration_s=3.0).frames())
    assert len(timed) == 30
    assert timed[-1].time_s == pytest.approx(3602.9)
    list(source.frames())
    assert source.problems == ["1 gap in the recording (first: 3600.0 s before frame 20)"]


def two_streams(path: Path) -> Path:
    with av.open(f"file:{path}", "w") as container:
        streams: list[Any] = []
        for size in ((32, 24), (64, 48), (48, 32)):
            stream: Any = container.add_stream("mpeg4", rate=10)
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"
            streams.append(stream)
        for number in range(5):
            for stream in streams:
                image = np.full((stream.height, stream.width, 3), 5 * number, np.uint8)
                frame = av.VideoFrame.from_ndarray(image, format="bgr24")
                frame.pts, frame.time_base = number, Fraction(1, 10)
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize(("stream", "size_wh"), [(None, (64, 48)), (0, (32, 24)), (1, (64, 48)), (2, (48, 32))])
def test_several_video_streams(tmp_path: Path, stream: int | None, size_wh: tuple[int, int]) -> None:
    source = open_frames(two_streams(tmp_path / "a.mp4"), stream=stream)
    assert source.size_wh == size_wh
    assert {f.image.shape[1::-1] for f in source.frames()} == {size_wh}
    number = 1 if stream is None else stream
    assert f"number {number} (from 0) of {size_wh[0]}x{size_wh[1]} is used" in source.notes[0]
    assert ("the largest" in source.notes[0]) is (stream is None)


def test_a_stream_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"stream 3: .* has video streams 0 to 2") as caught:
        open_frames(two_streams(tmp_path / "a.mp4"), stream=3)
    assert caught.value.parameters == ("stream",)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_pixels_that_are_not_square(tmp_path: Path, name: str) -> None:
    def wide(stream: Any) -> None:
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)

    path = write(tmp_path / name, size_wh=(96, 96), prepare=wide)
    source = VideoFile(path)
    assert source.size_wh == (128, 96)
    assert "1.333 times as wide as high" in source.notes[0]
    for frame in (next(source.frames()), next(source.frames(lambda n: True, lambda: 0.0))):
        assert frame.image.shape == (96, 128, 3)
        assert frame.grey.shape == (96, 128)
        assert frame.small_grey(3).shape == (32, 42)


@pytest.mark.parametrize("hflip", [False, True])
def test_mirrored_files(tmp_path: Path, hflip: bool) -> None:
    path = tmp_path / "a.mp4"
    with av.open(f"file:{path}", "w") as container:
        stream: Any = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, "yuv420p", 2_000_000
        stream.set_display_rotation(90, hflip=hflip)
        image = np.zeros((48, 64, 3), np.uint8)
        image[:16, :16] = 255
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    source = VideoFile(path)
    expected = np.rot90(image)[:, :: -1 if hflip else 1]
    frame = next(source.frames(lambda n: True, lambda: 0.0))
    assert np.abs(frame.image.astype(int) - expected).mean() < 8
    assert np.abs(frame.grey.astype(int) - expected[..., 0]).mean() < 8
    assert ("mirrored" in source.notes[0]) is hflip


def test_interlaced_files_are_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ts", codec="libx264", options={"x264-params": "interlaced=1"}, kind="mpegts")
    assert any("interlaced" in note for note in open_frames(path).notes)


def test_files_without_their_end(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mp4", size_wh=(320, 240), codec="libx264", options={"crf": "1"}).read_bytes()
    place = whole.find(b"moov") - 4
    for length, words in ((place, "its end is missing"), (place + 100, "cut off within its index")):
        (tmp_path / "cut.mp4").write_bytes(whole[:length])
        with pytest.raises(DataError, match=words) as caught:
            open_frames(tmp_path / "cut.mp4")
        assert "copy the file again" in str(caught.value)


def test_what_is_left_unread_is_told_as_well(tmp_path: Path) -> None:
    data = bytearray(write(tmp_path / "a.avi", size_wh=(160, 120), options={"g": "1"}).read_bytes())
    place = len(data) // 2
    data[place : place + 200] = bytes(np.random.default_rng(0).integers(0, 256, 200, dtype=np.uint8))
    (tmp_path / "damaged.avi").write_bytes(data)
    source = open_frames(tmp_path / "damaged.avi")
    frames = source.frames()
    for frame in frames:
        if frame.number == 30:
            break
    frames.close()  # type: ignore[attr-defined]
    assert source.problems
    assert not any("announced" in line for line in source.problems)


@pytest.mark.parametrize("name", ["x:1.avi", "tcp:cam 12:30.avi", "50%d ü.avi", "file:a.avi"])
def test_odd_characters_in_names(tmp_path: Path, name: str) -> None:
    with VideoWriter(tmp_path / name, 10.0, (64, 48)) as writer:
        for number in range(5):
            writer.write(np.full((48, 64, 3), 5 * number, np.uint8))
    assert len(list(open_frames(tmp_path / name).frames())) == 5
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_names_that_are_no_text(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not UTF-8"):
        VideoFile(tmp_path / "a\udcff.mp4")
