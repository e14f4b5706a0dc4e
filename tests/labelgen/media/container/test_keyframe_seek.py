"""A few frames of a video without decoding all: seeks from key frame to key frame, pictures on demand."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from labelgen.media.container.keyframe_seek import KeyframeSeek
from labelgen.media.frames import Frame, FrameSource, downscale, to_grey
from labelgen.media.open_frames import open_frames
from labelgen.media.video_reader import VideoFile

RATE = 10


def write_video(path: Path, count: int, key_every: int, *, codec: str = "mpeg4", full_range: bool = False) -> Path:
    """Write a video whose bright column encodes a frame's number."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=RATE)
        stream.width, stream.height, stream.pix_fmt = 320, 64, "yuvj420p" if full_range else "yuv420p"
        stream.codec_context.time_base = Fraction(1, RATE)
        stream.codec_context.options = {"g": str(key_every)} | ({"sc_threshold": "0"} if codec == "libx264" else {})
        stream.bit_rate = 4_000_000
        for i in range(count):
            image = np.full((64, 320, 3), (40, 90, 60), dtype=np.uint8)
            image[:, i : i + 8] = (200, 220, 250)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        out.mux(stream.encode(None))
    return path


def shown(image: np.ndarray) -> int:
    """Decode the number of the frame in a picture."""
    row = to_grey(image)[16:48].mean(axis=0)
    return round(float(np.average(np.arange(len(row)), weights=np.maximum(row - 150, 0))) - 3.5)


def walk(source: FrameSource, work_s: float, rest_s: float) -> list[Frame]:
    """Read for `work_s`, skip `rest_s`, and so on; return the frames."""
    begun, out, until = 0.0, [], [0.0]
    for frame in source.frames(lambda n: n / RATE >= until[-1], lambda: until[-1]):
        if frame.time_s > (out[-1].time_s if out else 0) + 0.5 * rest_s:
            begun = frame.time_s
        out.append(frame)
        if frame.time_s - begun >= work_s:
            until.append(frame.time_s + rest_s)
    return out


@pytest.mark.parametrize("codec", ["mpeg4", "libx264"])
@pytest.mark.parametrize("key_every", [5, 23, 1000])
def test_frames_after_a_seek_have_their_own_number_time_and_picture(tmp_path: Path, codec: str, key_every: int) -> None:
    source = VideoFile(write_video(tmp_path / "a.mp4", 300, key_every, codec=codec))
    frames = walk(source, 2.0, 3.0)
    assert [shown(f.image) for f in frames] == [f.number for f in frames]
    np.testing.assert_allclose([f.time_s for f in frames], [f.number / RATE for f in frames], atol=1e-6)
    gaps = np.diff([f.number for f in frames])
    assert set(gaps[gaps < 30]) == {1}
    # No frame comes before the wanted time, and seeks go no farther than to the next key frame.
    assert gaps[gaps > 1].min() >= 30
    assert gaps.max() <= 30 + min(key_every, 100)
    assert (gaps > 1).sum() >= 3
    assert source.problems == []


def test_a_seek_leaves_packets_undecoded(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", 300, 10)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        seek = KeyframeSeek(lambda: 12.0)

        def time_of(packet: Any) -> float:
            return np.nan if packet.pts is None else float(packet.pts * stream.time_base)

        times = [time_of(p) for p in seek.needed(container.demux(stream), time_of) if p.pts is not None]
    assert seek.skipped_packets == 120
    assert seek.resumed_s == 12.0
    assert min(times) == 12.0
    assert len(times) == 180


def test_where_key_frames_are_far_apart_nothing_is_lost(tmp_path: Path) -> None:
    source = VideoFile(write_video(tmp_path / "a.mp4", 300, 1000))
    frames = walk(source, 2.0, 5.0)
    gaps = np.diff([f.number for f in frames])
    assert set(gaps) == {1, 50}


def test_other_sources_pass_over_what_is_not_wanted(tmp_path: Path) -> None:
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((8, 8, 3), i, np.uint8))
    assert [f.number for f in open_frames(tmp_path).frames(lambda n: n != 2, lambda: 0.0)] == [0, 1, 3]


@pytest.mark.parametrize("full_range", [False, True])
def test_greys_are_those_of_the_picture(tmp_path: Path, full_range: bool) -> None:
    codec = "mjpeg" if full_range else "mpeg4"
    source = VideoFile(write_video(tmp_path / "a.avi", 3, 1, codec=codec, full_range=full_range))
    whole = list(source.frames())
    for lazy, eager in zip(source.frames(lambda n: True, lambda: 0.0), whole, strict=True):
        assert lazy.grey.shape == (64, 320)
        np.testing.assert_allclose(lazy.grey.astype(float), to_grey(eager.image), atol=4)
        assert abs(float(lazy.grey.mean()) - float(eager.grey.mean())) < 2
        assert lazy.small_grey(3).shape == (21, 106)
        for factor in (1, 3):
            np.testing.assert_allclose(lazy.small_grey(factor), downscale(lazy.grey, factor), atol=1)
            np.testing.assert_array_equal(eager.small_grey(factor), downscale(eager.grey, factor))
        np.testing.assert_array_equal(lazy.image, eager.image)
