"""Video files through PyAV: sequential, with each frame's own time stamp, whatever state the file is in.

OpenCV's reader is no option: it aborts the whole process on some valid files, and gives no time stamps to rely on.
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
from labelgen.media.frames import Frame, LazyFrame, always, shrunk
from labelgen.media.keyframe_seek import Leap

__all__ = ["VideoFile"]

# FFmpeg reads text as a terminal recording and follows play lists to other files and servers: neither is a video file.
_NOT_A_VIDEO = {"tty", "bin", "xbin", "adf", "idf", "hls", "dash", "webm_dash_manifest", "concat", "sdp", "rtsp", "sap"}
_OPEN_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": ",".join(sorted(av.formats_available - _NOT_A_VIDEO)),
}
# An announced count that was only computed from duration times rate may be off by this many frames and this share.
_COUNT_SLACK = (3, 0.02)
# Formats whose first plane is the picture's brightness in bytes; from 16 to 235 unless it is said to be of full range.
_WITH_BRIGHTNESS = {f"yuv{full}{rate}p" for full in ("", "j") for rate in (420, 422, 444)} | {"nv12"}
_FULL_RANGE = 2
_STRETCH = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)
_QUARTER_TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}


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
            first = next(self._decode(container.demux(stream), stream, _Tally()), None)
            if first is None:
                raise DataError(f"{self.path}: no frame of it can be decoded; the file is damaged or cut off")
            self._coded_wh = (int(first.width), int(first.height))
            self._turn = _quarter_turn(first)
            self.size_wh = self._coded_wh[::-1] if self._turn in (90, 270) else self._coded_wh

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
        leap = Leap(not_before_s)
        for number, time_s, decoded in self._pass(leap):
            if wanted(number) and not time_s < leap.landed_s:
                convert, take_greys = partial(self._image, decoded, reformatter), partial(self._greys, decoded)
                yield LazyFrame(number, time_s, convert, take_greys)

    def _pass(self, leap: Leap | None) -> Iterator[tuple[int, float, Any]]:
        """Number, time in s and frame as decoded of all that a pass over the file decodes."""
        self.problems = []
        tally = _Tally()
        first_pts: int | None = None
        latest = -math.inf
        number = -1
        with self._open() as container:
            stream = self._stream(container)
            base = float(stream.time_base) if stream.time_base else math.nan

            def time_of(thing: Any) -> float:
                return math.nan if thing.pts is None or first_pts is None else (thing.pts - first_pts) * base

            packets = container.demux(stream)
            if leap is not None:
                packets = leap.over(packets, time_of)
            for count, decoded in enumerate(self._decode(packets, stream, tally)):
                number = count + (leap.dropped if leap is not None else 0)
                if number == 0:
                    first_pts = decoded.pts
                if (decoded.width, decoded.height) != self._coded_wh:
                    tally.other_size(number, (decoded.width, decoded.height))
                    continue
                time_s = time_of(decoded)
                if math.isnan(time_s) and self.fps:
                    time_s = number / self.fps
                tally.backwards += time_s < latest
                latest = max(latest, time_s)
                yield number, time_s, decoded
        self.problems = tally.problems(number + 1, self.frame_count, self._count_is_exact, self.size_wh)

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

    def _decode(self, packets: Iterator[Any], stream: Any, tally: _Tally) -> Iterator[Any]:
        """Frames as FFmpeg decodes them; damaged packets and a broken end are noted in the tally."""
        seen = 0
        while True:
            try:
                packet = next(packets, None)
            except (FFmpegError, EOFError) as error:
                tally.end = getattr(error, "strerror", None) or "unreadable data"
                # What the decoder still holds is good.
                packet = None
            if packet is None and tally.end is None:
                return
            try:
                decoded = stream.codec_context.decode(packet) if packet is None else packet.decode()
            except (FFmpegError, EOFError):
                tally.damaged_packet(seen)
                decoded = []
            for frame in decoded:
                tally.damaged_frame(seen, bool(frame.is_corrupt))
                seen += 1
                yield frame
            if packet is None:
                return

    def _image(self, decoded: Any, reformatter: Any) -> NDArray[np.uint8]:
        image = reformatter.reformat(decoded, format="bgr24", threads=self._threads or None).to_ndarray()
        return _turned(image, self._turn)

    def _greys(self, decoded: Any, factor: int) -> NDArray[np.uint8] | None:
        """The decoder's brightness at a factor, stretched as the colours are; None where it has none of 8 bits."""
        if decoded.format.name not in _WITH_BRIGHTNESS:
            return None
        plane = decoded.planes[0]
        greys = np.frombuffer(plane, dtype=np.uint8).reshape(-1, plane.line_size)[: decoded.height, : decoded.width]
        greys = shrunk(greys, factor)
        if decoded.color_range != _FULL_RANGE and not decoded.format.name.startswith("yuvj"):
            greys = np.asarray(cv2.LUT(greys, _STRETCH), dtype=np.uint8)
        return _turned(greys, self._turn)


class _Tally:
    """What went wrong during one pass over a file."""

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
        """One line per kind of trouble, given how many frames came and how many were announced."""
        found = []
        if announced is not None:
            slack = 0 if exact else max(_COUNT_SLACK[0], int(announced * _COUNT_SLACK[1]))
            # Packets that gave no frame are told below; they do not make the file a truncated one.
            if count + self._packets < announced - slack:
                about = "" if exact else "about "
                found.append(
                    f"ended after {count} of {about}{announced} announced frames: the file is truncated or damaged"
                )
        if self.end is not None:
            found.append(f"reading stopped after frame {count - 1}: {self.end.lower()}")
        if self._packets:
            found.append(f"{_many(self._packets, 'damaged packet')} skipped (first near frame {self._first_packet})")
        if self._frames:
            found.append(f"{_many(self._frames, 'frame')} decoded with errors, kept (first: frame {self._first_frame})")
        if self._sizes:
            now, was = ("{}x{}".format(*wh) for wh in (self._other_wh, size_wh))
            found.append(
                f"{_many(self._sizes, 'frame')} of another size skipped (first: frame {self._first_size}, "
                f"{now} instead of {was})"
            )
        if self.backwards:
            found.append(f"{_many(self.backwards, 'time stamp')} before an earlier frame's")
        return found


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _positive(rate: Any) -> float | None:
    return float(rate) if rate is not None and rate > 0 else None


def _announced(stream: Any, container: Any, fps: float | None) -> tuple[int | None, bool]:
    """How many frames the file announces, and whether it names the number itself rather than a duration."""
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


def _quarter_turn(decoded: Any) -> int:
    """Counter-clockwise turn, degrees, that the file asks for before showing: 0, 90, 180 or 270."""
    return round(int(decoded.rotation) / 90) * 90 % 360


def _turned(picture: NDArray[np.uint8], degrees: int) -> NDArray[np.uint8]:
    """A picture (H, W[, C]) turned counter-clockwise by quarter turns."""
    return np.ascontiguousarray(cv2.rotate(picture, _QUARTER_TURNS[degrees]) if degrees else picture)
