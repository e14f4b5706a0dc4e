"""Read video files through PyAV: in sequence, with each frame's own time stamp, damaged files included.

OpenCV's reader is not used: it aborts the process on some valid files, and its time stamps are unreliable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.media.frames import Frame, LazyFrame, always, downscale
from labelgen.media.keyframe_seek import KeyframeSeek

__all__ = ["VideoFile"]

# Not video files: text, which FFmpeg renders as a terminal recording, and play lists, which lead to other addresses.
_NOT_A_VIDEO = {"tty", "bin", "xbin", "adf", "idf", "hls", "dash", "webm_dash_manifest", "concat", "sdp", "rtsp", "sap"}
_OPEN_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": ",".join(sorted(av.formats_available - _NOT_A_VIDEO)),
}
# A frame count computed from duration times rate may be off by this many frames, or by this share of them.
_COUNT_SLACK = (3, 0.02)
# Pixel formats whose first plane is luma in bytes, from 16 to 235 unless the stream declares full range.
_LUMA_FORMATS = {f"yuv{full}{rate}p" for full in ("", "j") for rate in (420, 422, 444)} | {"nv12"}
_FULL_RANGE = 2
_TO_FULL_RANGE = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)
_ROTATIONS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}


class VideoFile:
    """A video file as a `labelgen.media.frames.FrameSource`.

    Args:
        path: any file FFmpeg reads; its first real video stream is used.
        threads: decoding threads; 0 leaves it to the decoder.

    Raises:
        DataError: the file is missing, empty, no video, without a video stream, or without one readable frame.
    """

    is_live = False
    failure: Exception | None = None

    def __init__(self, path: str | Path, *, threads: int = 0) -> None:
        self.path = Path(path)
        self.name = self.path.stem
        self.problems: list[str] = []
        self._threads = threads
        if not self.path.is_file():
            raise DataError(f"{self.path}: no such video file")
        if self.path.stat().st_size == 0:
            raise DataError(f"{self.path}: the file is empty; copy it again")
        with self._open() as container:
            stream = self._stream(container)
            self.fps = _positive(stream.average_rate) or _positive(stream.guessed_rate)
            self.frame_count, self._count_is_exact = _announced(stream, container, self.fps)
            first = next(self._decode(container.demux(stream), stream, _ProblemCounts()), None)
            if first is None:
                raise DataError(f"{self.path}: no frame of it can be decoded; the file is damaged or cut off")
            self._coded_wh = (int(first.width), int(first.height))
            self._degrees = _rotation(first)
            self.size_wh = self._coded_wh[::-1] if self._degrees in (90, 270) else self._coded_wh

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """Return the wanted frames; see `FrameSource.frames`. Afterwards `problems` lists what was skipped.

        With `not_before_s` the frames are `LazyFrame`s, each of which keeps the decoder's picture in memory.
        """
        reformatter = av.video.reformatter.VideoReformatter()
        if not_before_s is None:
            for number, time_s, decoded in self._pass(None):
                if wanted(number):
                    yield Frame(number, time_s, self._image(decoded, reformatter))
            return
        seek = KeyframeSeek(not_before_s)
        for number, time_s, decoded in self._pass(seek):
            if wanted(number) and not time_s < seek.resumed_s:
                convert, read_grey = partial(self._image, decoded, reformatter), partial(self._grey, decoded)
                yield LazyFrame(number, time_s, convert, read_grey)

    def _pass(self, seek: KeyframeSeek | None) -> Iterator[tuple[int, float, Any]]:
        """Yield number, time in s and decoder's frame of every frame that one pass over the file decodes."""
        self.problems = []
        counts = _ProblemCounts()
        first_pts: int | None = None
        latest = -math.inf
        number = -1
        with self._open() as container:
            stream = self._stream(container)
            base = float(stream.time_base) if stream.time_base else math.nan

            def time_of(thing: Any) -> float:
                return math.nan if thing.pts is None or first_pts is None else (thing.pts - first_pts) * base

            packets = container.demux(stream)
            if seek is not None:
                packets = seek.needed(packets, time_of)
            for count, decoded in enumerate(self._decode(packets, stream, counts)):
                number = count + (seek.skipped_packets if seek is not None else 0)
                if number == 0:
                    first_pts = decoded.pts
                if (decoded.width, decoded.height) != self._coded_wh:
                    counts.other_size(number, (decoded.width, decoded.height))
                    continue
                time_s = time_of(decoded)
                if math.isnan(time_s) and self.fps:
                    time_s = number / self.fps
                counts.backwards += time_s < latest
                latest = max(latest, time_s)
                yield number, time_s, decoded
        self.problems = counts.problems(number + 1, self.frame_count, self._count_is_exact, self.size_wh)

    def _open(self) -> AbstractContextManager[Any]:
        try:
            # The prefix keeps a colon in the path from being read as a protocol.
            container: AbstractContextManager[Any] = av.open(
                f"file:{self.path}", options=_OPEN_OPTIONS, metadata_errors="replace"
            )
        except (av.error.InvalidDataError, av.error.ArgumentError):
            raise DataError(f"{self.path}: not a video file, or one damaged at its beginning") from None
        except FFmpegError as error:
            reason = (error.strerror or type(error).__name__).lower()
            raise DataError(f"{self.path}: the video cannot be opened ({reason})") from None
        return container

    def _stream(self, container: Any) -> Any:
        pictures = av.stream.Disposition.attached_pic
        streams = [s for s in container.streams.video if not s.disposition & pictures]
        if not streams:
            kinds = ", ".join(sorted({s.type for s in container.streams})) or "no"
            raise DataError(f"{self.path}: it holds no video stream ({kinds} streams only)")
        if streams[0].codec_context is None:
            raise DataError(f"{self.path}: its video codec is not known to this FFmpeg; convert the file to H.264")
        streams[0].thread_type = "AUTO"
        streams[0].codec_context.thread_count = self._threads
        return streams[0]

    def _decode(self, packets: Iterator[Any], stream: Any, counts: _ProblemCounts) -> Iterator[Any]:
        """Yield frames as FFmpeg decodes them; count damaged packets and a broken end."""
        frame_count = 0
        while True:
            try:
                packet = next(packets, None)
            except (FFmpegError, EOFError) as error:
                counts.end = getattr(error, "strerror", None) or "unreadable data"
                # The frames that the decoder still holds are good.
                packet = None
            if packet is None and counts.end is None:
                return
            try:
                decoded = stream.codec_context.decode(packet) if packet is None else packet.decode()
            except (FFmpegError, EOFError):
                counts.damaged_packet(frame_count)
                decoded = []
            for frame in decoded:
                counts.damaged_frame(frame_count, bool(frame.is_corrupt))
                frame_count += 1
                yield frame
            if packet is None:
                return

    def _image(self, decoded: Any, reformatter: Any) -> NDArray[np.uint8]:
        image = reformatter.reformat(decoded, format="bgr24", threads=self._threads or None).to_ndarray()
        return _rotate(image, self._degrees)

    def _grey(self, decoded: Any, factor: int) -> NDArray[np.uint8] | None:
        """Return the decoder's luma, downscaled and in full range; None where it has no luma plane of 8 bits."""
        if decoded.format.name not in _LUMA_FORMATS:
            return None
        plane = decoded.planes[0]
        grey = np.frombuffer(plane, dtype=np.uint8).reshape(-1, plane.line_size)[: decoded.height, : decoded.width]
        grey = downscale(grey, factor)
        if decoded.color_range != _FULL_RANGE and not decoded.format.name.startswith("yuvj"):
            grey = np.asarray(cv2.LUT(grey, _TO_FULL_RANGE), dtype=np.uint8)
        return _rotate(grey, self._degrees)


class _ProblemCounts:
    """Counts of what went wrong in one pass over a file."""

    def __init__(self) -> None:
        self.end: str | None = None
        self.backwards = 0
        self._packets = self._frames = self._sizes = 0
        self._first_packet = self._first_frame = self._first_size = 0
        self._other_wh = (0, 0)

    def damaged_packet(self, number: int) -> None:
        self._first_packet = self._first_packet if self._packets else number
        self._packets += 1

    def damaged_frame(self, number: int, damaged: bool) -> None:
        if damaged:
            self._first_frame = self._first_frame if self._frames else number
            self._frames += 1

    def other_size(self, number: int, size_wh: tuple[int, int]) -> None:
        if not self._sizes:
            self._first_size, self._other_wh = number, size_wh
        self._sizes += 1

    def problems(self, count: int, announced: int | None, exact: bool, size_wh: tuple[int, int]) -> list[str]:
        """Describe each kind of problem in one line, given how many frames came and how many were announced."""
        lines = []
        if announced is not None:
            slack = 0 if exact else max(_COUNT_SLACK[0], int(announced * _COUNT_SLACK[1]))
            # Damaged packets are reported below; they are no sign that the file is truncated.
            if count + self._packets < announced - slack:
                about = "" if exact else "about "
                lines.append(
                    f"ended after {count} of {about}{announced} announced frames: the file is truncated or damaged"
                )
        if self.end is not None:
            lines.append(f"reading stopped after frame {count - 1}: {self.end.lower()}")
        if self._packets:
            lines.append(f"{_many(self._packets, 'damaged packet')} skipped (first near frame {self._first_packet})")
        if self._frames:
            lines.append(f"{_many(self._frames, 'frame')} decoded with errors, kept (first: frame {self._first_frame})")
        if self._sizes:
            new, old = ("{}x{}".format(*wh) for wh in (self._other_wh, size_wh))
            lines.append(
                f"{_many(self._sizes, 'frame')} of another size skipped (first: frame {self._first_size}, "
                f"{new} instead of {old})"
            )
        if self.backwards:
            lines.append(f"{_many(self.backwards, 'time stamp')} before an earlier frame's")
        return lines


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _positive(rate: Any) -> float | None:
    return float(rate) if rate is not None and rate > 0 else None


def _announced(stream: Any, container: Any, fps: float | None) -> tuple[int | None, bool]:
    """Return how many frames the file announces, and whether it states the number itself rather than a duration."""
    if stream.frames > 0:
        return int(stream.frames), True
    seconds = None
    if stream.duration and stream.time_base:
        seconds = float(stream.duration * stream.time_base)
    elif container.duration:
        seconds = container.duration / av.time_base
    if seconds is None or fps is None or not 0 < seconds * fps < 2**31:
        return None, False
    return max(1, round(seconds * fps)), False


def _rotation(decoded: Any) -> int:
    """Return the rotation that the file asks for, degrees counter-clockwise: 0, 90, 180 or 270."""
    return round(int(decoded.rotation) / 90) * 90 % 360


def _rotate(picture: NDArray[np.uint8], degrees: int) -> NDArray[np.uint8]:
    """Rotate a picture (H, W[, C]) counter-clockwise by 0, 90, 180 or 270 degrees."""
    return np.ascontiguousarray(cv2.rotate(picture, _ROTATIONS[degrees]) if degrees else picture)
