"""Camera streams over a local HTTP server."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from speed_scenes import write_video
from stream_server import serve_stream

from labelgen.errors import DataError
from labelgen.media.stream import VideoStream, is_stream_url
from labelgen.media.timed_frames import TimedFrames


def recording(path: Path, times_s: list[float], size_wh: tuple[int, int] = (64, 48)) -> bytes:
    pictures = [np.full((size_wh[1], size_wh[0], 3), 3 * n % 250, np.uint8) for n in range(len(times_s))]
    write_video(path, pictures, times_s)
    return path.read_bytes()


STEADY = [n / 25 for n in range(50)]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("http://camera/a.ts", True),
        ("RTSP://user:word@10.0.0.1:554/live", True),
        ("file:///etc/passwd", False),
        ("video.mp4", False),
        ("/data/http/video.mp4", False),
        ("ftp://host/a.ts", False),
    ],
)
def test_what_is_a_stream(source: str, expected: bool) -> None:
    assert is_stream_url(source) is expected


def test_a_stream_that_ends(tmp_path: Path) -> None:
    data = recording(tmp_path / "a.ts", STEADY)
    with serve_stream(data, announced=len(data)) as url:
        stream = VideoStream(url, duration_s=60, stall_s=5)
        frames = list(stream.frames())
    assert (stream.size_wh, stream.name, stream.frame_count) == ((64, 48), "camera", None)
    assert [f.number for f in frames] == list(range(len(frames)))
    assert len(frames) >= 48
    assert [f.time_s for f in frames] == pytest.approx(STEADY[: len(frames)], abs=1e-3)
    assert frames[0].image.shape == (48, 64, 3)
    assert stream.is_live
    assert stream.failure is None
    assert "ended after" in stream.problems[0]


def test_a_stream_is_read_once(tmp_path: Path) -> None:
    with serve_stream(recording(tmp_path / "a.ts", STEADY)) as url:
        stream = VideoStream(url, stall_s=5)
        list(stream.frames())
        with pytest.raises(DataError, match="only once"):
            next(stream.frames())


def test_a_stream_is_left_after_its_time(tmp_path: Path) -> None:
    with serve_stream(recording(tmp_path / "a.ts", STEADY), stall=True) as url:
        stream = VideoStream(url, duration_s=1.0, stall_s=30)
        assert len(list(stream.frames())) == 25
        assert (stream.failure, stream.problems) == (None, [])


def test_a_stream_that_stalls(tmp_path: Path) -> None:
    with serve_stream(recording(tmp_path / "a.ts", STEADY), stall=True) as url:
        stream = VideoStream(url, stall_s=0.5)
        frames = list(stream.frames())
    assert len(frames) >= 48
    assert "stalled, no data for 0.5 s" in str(stream.failure)
    assert TimedFrames(stream).failure is stream.failure
    assert TimedFrames(stream).is_live


def test_a_stream_that_drops_frames(tmp_path: Path) -> None:
    times = [t for n, t in enumerate(STEADY) if not 20 <= n < 30]
    with serve_stream(recording(tmp_path / "a.ts", times)) as url:
        stream = VideoStream(url, stall_s=5)
        frames = list(stream.frames())
    assert np.diff([f.time_s for f in frames]).max() == pytest.approx(11 / 25, abs=2e-3)
    assert any("10 frames were dropped" in problem for problem in stream.problems)


def test_a_stream_that_changes_its_resolution(tmp_path: Path) -> None:
    data = recording(tmp_path / "a.ts", STEADY)
    data += recording(tmp_path / "b.ts", [2 + t for t in STEADY], (96, 64))
    with serve_stream(data) as url:
        stream = VideoStream(url, stall_s=5)
        frames = list(stream.frames())
    assert {f.image.shape for f in frames} == {(48, 64, 3)}
    assert "resolution changed from 64x48 to 96x64" in str(stream.failure)


def test_a_stream_of_pixels_that_are_not_square(tmp_path: Path) -> None:
    path = tmp_path / "a.ts"
    with av.open(str(path), "w", format="mpegts") as container:
        video: Any = container.add_stream("libx264", rate=10, options={"tune": "zerolatency"})
        video.width, video.height, video.pix_fmt = 96, 96, "yuv420p"
        video.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for _ in range(20):
            container.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((96, 96, 3), np.uint8), format="bgr24")))
        container.mux(video.encode(None))
    with serve_stream(path.read_bytes()) as url:
        stream = VideoStream(url, stall_s=5)
        frames = list(stream.frames())
    assert stream.size_wh == (128, 96)
    assert {frame.image.shape for frame in frames} == {(96, 128, 3)}
    assert "1.333 times as wide as high" in stream.notes[0]


def test_a_stream_whose_clock_starts_anew(tmp_path: Path) -> None:
    data = recording(tmp_path / "a.ts", STEADY)
    with serve_stream(data + data) as url:
        stream = VideoStream(url, stall_s=5)
        found = [frame.time_s for frame in stream.frames()]
    assert len(found) >= 96
    assert np.diff(found) == pytest.approx(0.04, abs=0.002)
    assert any("the clock jumped back 1 time" in problem for problem in stream.problems)


@pytest.mark.parametrize("data", [b"", b"<html>no camera here</html>" * 50])
def test_what_is_no_video(data: bytes) -> None:
    with serve_stream(data) as url, pytest.raises(DataError, match=f"stream {url}"):
        VideoStream(url, stall_s=5)


def test_nobody_answers() -> None:
    with serve_stream(b"") as url:
        gone = url
    with pytest.raises(DataError, match="cannot be opened"):
        VideoStream(gone, stall_s=2)
