"""Small videos of every kind that decoders know: codecs, frames out of order, open groups, odd stamps, damage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

__all__ = ["RECORDINGS", "Recording", "pictures", "write_recording"]

MS = Fraction(1, 1000)


@dataclass(frozen=True)
class Recording:
    """How a video is made.

    Args:
        name: of the file; its suffix says the container.
        codec: name of the encoder.
        options: of the encoder.
        stamps_ms: of the frames, ms; None for 25 frames per second.
        late_ms: added to all stamps in the container, ms.
        drop_packets: number of packets that the file lacks at its beginning.
        count: number of frames.
        container_options: of the container.
        key_at: returns whether a frame is made a key frame, besides those of the encoder.
    """

    name: str
    codec: str
    options: dict[str, str] = field(default_factory=dict)
    stamps_ms: Sequence[int] | None = None
    late_ms: int = 0
    drop_packets: int = 0
    count: int = 70
    container_options: dict[str, str] = field(default_factory=dict)
    key_at: Callable[[int], bool] = lambda number: False


def pictures(count: int, size_wh: tuple[int, int] = (96, 64), seed: int = 0) -> list[np.ndarray]:
    """Draw frames (H, W, 3) uint8 of a textured ground, noise and two moving blocks, each unlike the others."""
    rng = np.random.default_rng(seed)
    width, height = size_wh
    ground = rng.integers(60, 160, (height, width, 3), dtype=np.uint8)
    frames = []
    for number in range(count):
        image = ground.copy()
        left = (7 * number) % (width - 16)
        image[10:26, left : left + 16] = (30 + 3 * number % 200, 60, 200)
        image[40:52, width - 20 - left // 2 : width - 4 - left // 2] = (200, 3 * number % 250, 40)
        image[::4, ::4] = rng.integers(0, 255, image[::4, ::4].shape, dtype=np.uint8)
        frames.append(image)
    return frames


def write_recording(folder: Path, recording: Recording, size_wh: tuple[int, int] = (96, 64)) -> Path:
    """Write the file of a recording."""
    path = folder / recording.name
    with av.open(str(path), "w", options=recording.container_options) as container:
        stream: Any = container.add_stream(recording.codec, rate=25, options=recording.options)
        stream.width, stream.height = size_wh
        stream.pix_fmt = "yuvj420p" if recording.codec == "mjpeg" else "yuv420p"
        stream.codec_context.thread_count = 1
        if recording.stamps_ms is not None:
            stream.codec_context.time_base = MS
        packets = []
        for number, image in enumerate(pictures(recording.count, size_wh)):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format=stream.pix_fmt)
            frame.pts = number if recording.stamps_ms is None else recording.stamps_ms[number]
            frame.time_base = Fraction(1, 25) if recording.stamps_ms is None else MS
            if recording.key_at(number):
                frame.pict_type = av.video.frame.PictureType.I
            packets += stream.encode(frame)
        for packet in [*packets, *stream.encode(None)][recording.drop_packets :]:
            late = round(recording.late_ms * MS / packet.time_base)
            packet.pts, packet.dts = packet.pts + late, packet.dts + late
            container.mux(packet)
    return path


def _x264(bf: int = 0, g: int = 12, more: str = "", **options: str) -> dict[str, str]:
    return {"bf": str(bf), "g": str(g), "x264-params": f"scenecut=0:threads=1{more}", "preset": "veryfast", **options}


_UNEVEN_MS = np.cumsum(np.random.default_rng(3).integers(5, 300, 70)).tolist()
_GAP_MS = [40 * n + (30_000 if n >= 30 else 0) for n in range(70)]
_SCATTERED = frozenset({7, 8, 30, 31, 49})

RECORDINGS = {
    "h264": Recording("a.mp4", "libx264", _x264()),
    "h264 with B frames": Recording("a.mp4", "libx264", _x264(3)),
    "h264 with B frames in MKV": Recording("a.mkv", "libx264", _x264(3, 23)),
    "h264 with B frames in TS": Recording("a.ts", "libx264", _x264(3, 10)),
    "h264 with a pyramid": Recording("a.mp4", "libx264", _x264(7, 30, ":b-pyramid=normal:b-adapt=2:ref=4")),
    "h264, open groups": Recording("a.mp4", "libx264", _x264(3, 12, ":open-gop=1")),
    "h264, open groups in TS": Recording("a.ts", "libx264", _x264(3, 17, ":open-gop=1")),
    "h264, open groups, cut at the start": Recording("a.ts", "libx264", _x264(3, 12, ":open-gop=1"), drop_packets=5),
    "h264, refreshed bit by bit": Recording("a.ts", "libx264", _x264(0, 15, ":intra-refresh=1")),
    "h264, key frames anywhere": Recording("a.mp4", "libx264", _x264(2, 1000), key_at=_SCATTERED.__contains__),
    "h264, one key frame": Recording("a.mp4", "libx264", _x264(2, 1000)),
    "h264, all key frames": Recording("a.mp4", "libx264", _x264(0, 1)),
    "h264, cut in a group": Recording("a.ts", "libx264", _x264(2, 12), drop_packets=17),
    "h264, interlaced": Recording("a.ts", "libx264", _x264(2, 12, ":interlaced=1")),
    "h264 in AVI": Recording("a.avi", "libx264", _x264(0, 11)),
    "h264 with B frames in AVI": Recording("a.avi", "libx264", _x264(2, 11)),
    "h264, raw": Recording("a.h264", "libx264", _x264(2, 11)),
    "hevc": Recording("a.mp4", "libx265", {"x265-params": "keyint=12:bframes=3:scenecut=0:log-level=none:pools=1"}),
    "hevc, closed groups": Recording(
        "a.ts", "libx265", {"x265-params": "keyint=12:bframes=3:open-gop=0:log-level=none:pools=1"}
    ),
    "mpeg4": Recording("a.avi", "mpeg4", {"g": "12", "qscale": "3"}),
    "mpeg4 with B frames": Recording("a.mp4", "mpeg4", {"g": "13", "bf": "2", "qscale": "3"}),
    "mpeg4, quarter pixels": Recording("a.mkv", "mpeg4", {"g": "20", "bf": "1", "flags": "+qpel+mv4", "qscale": "3"}),
    "mpeg2 in TS": Recording("a.ts", "mpeg2video", {"g": "12", "bf": "2", "qscale": "3"}),
    "mjpeg": Recording("a.avi", "mjpeg", {"qmin": "2", "qmax": "4"}),
    "mjpeg, raw": Recording("a.mjpeg", "mjpeg", {"qmin": "2", "qmax": "4"}),
    "vp9": Recording("a.webm", "libvpx-vp9", {"g": "15", "lag-in-frames": "12", "auto-alt-ref": "1", "cpu-used": "8"}),
    "uneven stamps": Recording("a.mkv", "libx264", _x264(2, 12), stamps_ms=_UNEVEN_MS),
    "a gap": Recording("a.mkv", "libx264", _x264(2, 12), stamps_ms=_GAP_MS),
    "late stamps": Recording("a.ts", "libx264", _x264(3, 12), late_ms=7_000_000),
    "early stamps": Recording(
        "a.mkv", "libx264", _x264(3, 12), late_ms=-1000, container_options={"avoid_negative_ts": "disabled"}
    ),
    "an edit list": Recording("a.mp4", "libx264", _x264(3, 12), late_ms=-440, container_options={"use_editlist": "1"}),
}
