"""Interlaced recordings: noted, and deinterlaced on request, one whole frame for each frame."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from interlaced_clips import bar, write_interlaced
from stream_server import serve_stream

from labelgen.errors import DataError
from labelgen.media.open_frames import open_frames
from labelgen.media.stream import VideoStream
from labelgen.media.video_reader import VideoFile

FRAMES, FPS = 12, 10


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_interlaced(tmp_path_factory.mktemp("fields") / "fields.ts", FRAMES, FPS)


def torn(image: np.ndarray, number: int) -> float:
    """Share of a frame that differs from the true one at its time, in percent."""
    return 100 * float((np.abs(image.astype(float) - bar(number)) > 30).mean())


def test_interlaced_frames_become_whole(video: Path) -> None:
    plain, whole = VideoFile(video), VideoFile(video, deinterlace=True)
    assert any("set deinterlace" in note for note in plain.notes)
    assert whole.notes == ["its frames are deinterlaced, as asked"]
    before, after = list(plain.frames()), list(whole.frames())
    assert [f.number for f in after] == [f.number for f in before] == list(range(FRAMES))
    assert [f.time_s for f in after] == [f.time_s for f in before] == pytest.approx(np.arange(FRAMES) / FPS)
    assert whole.problems == plain.problems == []
    for old, new in zip(before, after, strict=True):
        assert torn(old.image, old.number) > 1
        assert torn(new.image, new.number) < 0.25
    some = list(whole.frames(lambda n: n % 5 == 0))
    assert [f.number for f in some] == [0, 5, 10]
    assert all(np.array_equal(f.image, after[f.number].image) for f in some)


def test_the_grey_levels_are_those_of_whole_frames(video: Path) -> None:
    for frame in VideoFile(video, deinterlace=True).frames(not_before_s=lambda: 0.0):
        assert torn(np.repeat(frame.grey[..., None], 3, axis=2), frame.number) < 0.25


@pytest.mark.parametrize("kind", ["h264", "mjpeg"])
def test_frames_without_stamps_and_progressive_ones(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"plain.{kind}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream({"h264": "libx264", "mjpeg": "mjpeg"}[kind], rate=FPS)
        stream.width, stream.height, stream.pix_fmt = 320, 180, "yuvj420p" if kind == "mjpeg" else "yuv420p"
        for number in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(bar(number), format="bgr24").reformat(format=stream.pix_fmt)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    frames = list(VideoFile(path, fps=FPS, deinterlace=True).frames())
    assert [(f.number, f.time_s) for f in frames] == [(n, pytest.approx(n / FPS)) for n in range(FRAMES)]


def test_a_stream_is_deinterlaced(video: Path) -> None:
    with serve_stream(video.read_bytes()) as url:
        camera = VideoStream(url, stall_s=5, deinterlace=True)
        frames = list(camera.frames())
    assert [f.number for f in frames] == list(range(FRAMES))
    assert max(torn(f.image, f.number) for f in frames) < 0.25


def test_images_are_not_deinterlaced(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="deinterlace is for videos"):
        open_frames(tmp_path, deinterlace=True)
