"""Sparse decoding gives the frames, numbers, times and bytes of decoding in sequence, whatever the file."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from video_zoo import RECORDINGS, write_recording

from labelgen.errors import DataError
from labelgen.media.container.sparse_decoding import NotSparseError, SparseDecoder
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import Frame
from labelgen.media.open_frames import open_frames
from labelgen.media.prefetch import prefetch
from labelgen.media.sparse_frames import sparse_frames
from labelgen.media.video_reader import VideoFile

# Where stamps or packets do not say which frames there are.
IN_SEQUENCE = {
    "h264, open groups, cut at the start",
    "h264, refreshed bit by bit",
    "h264, cut in a group",
    "mpeg4, quarter pixels",
    "early stamps",
}


@pytest.fixture(scope="module")
def zoo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    files = {}
    for name, recording in RECORDINGS.items():
        folder = tmp_path_factory.mktemp("recording")
        files[name] = write_recording(folder, recording)
    return files


def same(frames: Sequence[Frame], expected: Sequence[Frame]) -> None:
    assert [f.number for f in frames] == [f.number for f in expected]
    np.testing.assert_array_equal([f.time_s for f in frames], [f.time_s for f in expected])
    assert [f.gaps_s for f in frames] == [f.gaps_s for f in expected]
    for frame, other in zip(frames, expected, strict=True):
        assert np.array_equal(frame.image, other.image), frame.number


class CountingContext:
    """A codec context that counts the packets it is given."""

    def __init__(self, context: Any) -> None:
        self.__dict__.update(context=context, count=0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.context, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.context, name, value)

    def decode(self, packet: Any) -> Any:
        self.__dict__["count"] += packet is not None
        return self.context.decode(packet)


def decoded_packets(path: Path, choice: FrameChoice) -> int:
    """Return how many packets the decoder gets for a choice."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = CountingContext(stream.codec_context)
        for _ in SparseDecoder(context, choice.begin()).frames(container.demux(stream)):
            pass
        return int(context.count)


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_so_many_frames(name: str, zoo: dict[str, Path]) -> None:
    source = VideoFile(zoo[name])
    whole = list(source.frames())
    problems = source.problems
    for every, first in ((1, 0), (3, 1), (25, 0), (33, 32)):
        choice = FrameChoice(wanted=lambda number, every=every, first=first: number % every == first)  # type: ignore[misc]
        same(list(sparse_frames(source, choice)), [f for f in whole if f.number % every == first])
        assert source.problems == problems
    same(list(sparse_frames(source, FrameChoice(25, limit=2))), [whole[0], whole[25]])


@pytest.mark.parametrize("name", RECORDINGS)
def test_key_frames(name: str, zoo: dict[str, Path]) -> None:
    source, every = VideoFile(zoo[name]), 20
    whole = {f.number: f for f in source.frames()}
    frames = list(sparse_frames(source, FrameChoice(every, keyframes=True)))
    assert frames
    same(frames, [whole[f.number] for f in frames])
    assert all(step >= every for step in np.diff([f.number for f in frames]))
    limited = list(sparse_frames(source, FrameChoice(every, keyframes=True, limit=2)))
    same(limited, frames[:2])
    # Which frames are taken does not depend on which of them are wanted.
    late = list(sparse_frames(source, FrameChoice(every, keyframes=True, wanted=lambda number: number > 30)))
    same(late, [f for f in frames if f.number > 30])


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("h264 with B frames", [0, 12, 24, 36, 48, 60]),
        ("h264, open groups", [0, 12, 24, 36, 48, 60]),
        ("h264, key frames anywhere", [0, 7, 8, 30, 31, 49]),
        ("h264, cut in a group", [0, 12, 24, 36]),  # the frames before the first key frame cannot be shown
        ("h264, one key frame", [0]),
        ("h264, refreshed bit by bit", [0]),
        ("an edit list", [1, 13, 25, 37, 49]),  # 11 frames of the file are cut away
        ("mjpeg", list(range(70))),
        ("vp9", [0, 15, 30, 45, 60]),
    ],
)
def test_key_frames_have_the_numbers_of_the_whole_video(name: str, keys: list[int], zoo: dict[str, Path]) -> None:
    frames = sparse_frames(VideoFile(zoo[name]), FrameChoice(keyframes=True))
    assert [f.number for f in frames] == keys


@pytest.mark.parametrize(
    ("name", "choice", "most"),
    [
        ("h264", FrameChoice(wanted={61}.__contains__), 12 + 2),  # the first group is always decoded
        ("h264", FrameChoice(keyframes=True), 12 + 5),
        ("h264", FrameChoice(limit=1), 12),
        ("h264", FrameChoice(wanted={59}.__contains__), 12 + 12),
        ("h264, open groups", FrameChoice(keyframes=True), 12 + 5),
        ("mpeg4", FrameChoice(24), 12 + 2),
        ("mjpeg", FrameChoice(10), 7),
    ],
)
def test_little_is_decoded(name: str, choice: FrameChoice, most: int, zoo: dict[str, Path]) -> None:
    assert 0 < decoded_packets(zoo[name], choice) <= most


@pytest.mark.parametrize("name", sorted(IN_SEQUENCE))
def test_files_that_are_decoded_in_sequence(name: str, zoo: dict[str, Path]) -> None:
    with pytest.raises(NotSparseError):
        decoded_packets(zoo[name], FrameChoice(25))


@pytest.mark.parametrize(
    "name", ["h264 with B frames in TS", "h264, open groups in TS", "mpeg4", "h264 with B frames in MKV"]
)
@pytest.mark.parametrize("seed", range(6))
def test_damaged_and_truncated_files(tmp_path: Path, name: str, seed: int, zoo: dict[str, Path]) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(zoo[name].read_bytes())
    if seed % 3 == 0:
        data = data[: int(len(data) * rng.uniform(0.4, 0.95))]
    for _ in range(2 if seed % 3 else 0):
        length = int(rng.choice([1, 40, 400]))
        place = int(rng.integers(1500, len(data) - length - 3000))
        data[place : place + length] = rng.bytes(length)
    path = tmp_path / zoo[name].name
    path.write_bytes(data)
    source = VideoFile(path, threads=1)  # with several threads the decoder itself does not mend damage in one way
    whole = list(source.frames())
    for every in (1, 7, 25):
        same(list(sparse_frames(source, FrameChoice(every))), [f for f in whole if f.number % every == 0])


def test_frames_keep_their_numbers_where_one_is_lost(tmp_path: Path, zoo: dict[str, Path]) -> None:
    data = bytearray(zoo["mjpeg"].read_bytes())
    place = -1
    for _ in range(21):
        place = data.index(b"00dc", place + 1)
    size = int.from_bytes(data[place + 4 : place + 8], "little")
    data[place + 8 : place + 8 + size] = bytes(size)  # one frame is no picture any more
    path = tmp_path / "damaged.avi"
    path.write_bytes(data)
    source = VideoFile(path)
    whole = list(VideoFile(zoo["mjpeg"]).frames())
    frames = list(source.frames())
    [lost] = {f.number for f in whole} - {f.number for f in frames}
    assert 15 < lost < 25
    same(frames, [f for f in whole if f.number != lost])
    assert any("1 damaged packet skipped" in problem for problem in source.problems)
    same(list(sparse_frames(source, FrameChoice(25))), [whole[0], whole[25], whole[50]])


def test_other_sources_are_read_whole(tmp_path: Path) -> None:
    for number in range(12):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((8, 8, 3), number, np.uint8))
    source = open_frames(tmp_path)
    for keyframes in (False, True):
        choice = FrameChoice(5, keyframes)
        assert [f.number for f in sparse_frames(source, choice)] == [0, 5, 10]
        assert [f.number for f in sparse_frames(source, FrameChoice(5, keyframes, limit=2))] == [0, 5]


def test_reading_ahead_ends_with_its_reader(zoo: dict[str, Path]) -> None:
    before = threading.active_count()
    source = VideoFile(zoo["h264"])
    for frames in (prefetch(sparse_frames(source, FrameChoice(2)), 3), sparse_frames(source, FrameChoice(2))):
        assert [f.number for f in islice(frames, 3)] == [0, 2, 4]
        frames.close()  # type: ignore[attr-defined]
    zoo["h264"].with_name("gone.mp4").write_bytes(zoo["h264"].read_bytes())
    gone = VideoFile(zoo["h264"].with_name("gone.mp4"))
    gone.path.unlink()
    with pytest.raises(DataError, match="cannot be opened"):
        list(prefetch(sparse_frames(gone, FrameChoice()), 3))
    assert threading.active_count() <= before


@pytest.mark.parametrize("choice", [FrameChoice(25), FrameChoice(20, keyframes=True), FrameChoice(7, limit=3)])
def test_deinterlacing_takes_every_frame(choice: FrameChoice, zoo: dict[str, Path]) -> None:
    source = VideoFile(zoo["h264, interlaced"], deinterlace=True)
    whole = {f.number: f for f in source.frames()}
    frames = list(sparse_frames(source, choice))
    assert len(frames) >= 3
    same(frames, [whole[f.number] for f in frames])
