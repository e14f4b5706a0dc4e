"""Read video files through PyAV: in sequence, with each frame's own time stamp, damaged files included.

OpenCV's reader is not used: it aborts the process on some valid files, and its time stamps are unreliable.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.media.container.damaged_file import why_unreadable
from labelgen.media.container.deinterlace import DEINTERLACED, deinterlaced
from labelgen.media.container.file_names import ffmpeg_name
from labelgen.media.container.file_stamps import ClockCarry, FileStamps
from labelgen.media.container.frame_clock import FrameClock, TimedItem
from labelgen.media.container.frame_geometry import FrameGeometry
from labelgen.media.container.keyframe_seek import KeyframeSeek
from labelgen.media.container.lost_frames import LostFrames
from labelgen.media.container.pass_state import PassState, ProblemCounts
from labelgen.media.container.sparse_decoding import NotSparseError, SparseDecoder, can_be_sparse
from labelgen.media.container.video_tracks import INTERLACED, display_matrix, pixel_count, stream_note
from labelgen.media.frame_choice import FrameChoice, FrameChooser
from labelgen.media.frames import Frame, LazyFrame, always, downscale

__all__ = ["VideoFile"]

# Not video files: text, which FFmpeg renders as a terminal recording, and play lists, which lead to other addresses.
_NOT_A_VIDEO = {"tty", "bin", "xbin", "adf", "idf", "hls", "dash", "webm_dash_manifest", "concat", "sdp", "rtsp", "sap"}
_OPEN_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": ",".join(sorted(av.formats_available - _NOT_A_VIDEO)),
}
# Pixel formats whose first plane is luma in bytes, from 16 to 235 unless the stream declares full range.
_LUMA_FORMATS = {f"yuv{full}{rate}p" for full in ("", "j") for rate in (420, 422, 444)} | {"nv12"}
_FULL_RANGE = 2
_TO_FULL_RANGE = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)
# Packets whose stamps are looked at when a file is opened.
_PROBE_PACKETS = 64


class VideoFile:
    """A video file as a `labelgen.media.frames.FrameSource`.

    Args:
        path: any file FFmpeg reads.
        threads: decoding threads; 0 leaves it to the decoder.
        fps: frames per second; used where the file holds no time stamps, or none that can be trusted.
        stream: number of the video stream to use, from 0, not counting cover pictures; None takes the largest.
        deinterlace: whether each frame is deinterlaced.

    Raises:
        DataError: the file is missing, empty, no video, without a (or this) video stream, or without one readable
            frame.
    """

    is_live = False
    failure: Exception | None = None

    def __init__(
        self,
        path: str | Path,
        *,
        threads: int = 0,
        fps: float | None = None,
        stream: int | None = None,
        deinterlace: bool = False,
    ) -> None:
        self.path = Path(path)
        self.name = self.path.stem
        self.notes: list[str] = []
        self.problems: list[str] = []
        self._threads, self._wanted_stream, self._deinterlace = threads, stream, deinterlace
        name = ffmpeg_name(self.path)  # refuses names that no file has
        if not self.path.is_file():
            raise DataError(f"{self.path}: no such video file")
        if self.path.stat().st_size == 0:
            raise DataError(f"{self.path}: the file is empty; copy it again")
        self._ffmpeg_name = name
        with self._open() as container:
            video = self._stream(container)
            first, stamps = self._probe(container, video)
            self._stamps = FileStamps.of(container, video, stamps, fps, first.pts)
            self.fps, self.untimed = self._stamps.fps, self._stamps.untimed
            self.frame_count, self.count_is_exact = _announced(video, container, self.fps)
            self._coded_wh = (int(first.width), int(first.height))
            self._geometry = FrameGeometry.of(self._coded_wh, video.sample_aspect_ratio, display_matrix(first))
            self.size_wh = self._geometry.size_wh
            streams = _real_streams(container)
            if len(streams) > 1:
                self.notes.append(stream_note(len(streams), streams.index(video), video, chosen=stream is not None))
            self.notes += [note for note in (self._geometry.note, self._stamps.note) if note]
            if deinterlace or first.interlaced_frame:
                self.notes.append(DEINTERLACED if deinterlace else INTERLACED)

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """Return the wanted frames; see `FrameSource.frames`. Afterwards `problems` lists what was skipped.

        With `not_before_s` the frames are `LazyFrame`s, each of which keeps the decoder's picture in memory.
        """
        reformatter = av.video.reformatter.VideoReformatter()
        if not_before_s is None:
            for number, time_s, gaps_s, decoded in self._pass(None):
                if wanted(number):
                    yield Frame(number, time_s, self._image(decoded, reformatter), "", gaps_s)
            return
        # Without time stamps nothing says which packets may be skipped.
        seek = KeyframeSeek(not_before_s) if self._stamps.are_times else None
        for number, time_s, gaps_s, decoded in self._pass(seek):
            if wanted(number):
                convert, read_grey = partial(self._image, decoded, reformatter), partial(self._grey, decoded)
                yield LazyFrame(number, time_s, convert, read_grey, gaps_s)

    def sparse_frames(self, choice: FrameChoice) -> Iterator[Frame]:
        """Yield the chosen frames without decoding more than they need; see `labelgen.media.sparse_frames`.

        Where packets do not say which frames there are, and from the first damage on, all frames are decoded.
        """
        reformatter = av.video.reformatter.VideoReformatter()
        for number, time_s, gaps_s, decoded in self._pass(None, choice):
            if decoded is not None:
                yield Frame(number, time_s, self._image(decoded, reformatter), "", gaps_s)

    def _pass(self, seek: KeyframeSeek | None, choice: FrameChoice | None = None) -> Iterator[TimedItem[Any]]:
        """Yield the decoder's frames of one pass over the file, with number and time.

        Args:
            seek: skips packets by time; None for none.
            choice: which frames are wanted. Of the other ones, not all of which are decoded, number and time are
                yielded. None for all.
        """
        self.problems = []
        clock = FrameClock(1 / self.fps if self.fps else None)
        state = PassState()
        unwanted: set[int] = set()

        def shown() -> Iterator[tuple[int, float, Any]]:
            nonlocal state
            if choice is None:
                yield from self._shown(state, self._in_sequence(state, seek))
                return
            begun, chooser = -1, choice.begin()
            if self._stamps.are_times and not self._deinterlace:
                with contextlib.suppress(NotSparseError):
                    yield from self._shown(state, self._sparse(state, chooser))
                    state.is_finished = not chooser.is_over
                    return
                begun, chooser, state = state.last, choice.begin(), PassState()
            for number, time_s, decoded in self._shown(state, self._in_sequence(state, None)):
                is_last = chooser.is_over  # one frame later than the last wanted one, whose time may depend on it
                if not chooser.takes(number, bool(decoded.key_frame)):
                    unwanted.add(number)
                if number > begun:
                    yield number, time_s, decoded
                if is_last:
                    return

        try:
            if self._stamps.are_times:
                items = clock.timed(shown())
            else:
                items = (TimedItem(number, time_s, 0.0, frame) for number, time_s, frame in shown())
            for item in deinterlaced(items) if self._deinterlace else items:
                yield item._replace(item=None) if item.number in unwanted else item
                unwanted.discard(item.number)
        finally:
            self.problems = [*clock.problems(), *(state.carry.problems() if state.carry is not None else ())]
            # With gaps and jumps in the stamps a number computed from the duration means nothing.
            known = state.is_finished and (self.count_is_exact or not self.problems)
            announced = self.frame_count if known else None
            self.problems[:0] = state.counts.problems(state.last + 1, announced, self.count_is_exact, self.size_wh)

    def _shown(
        self, state: PassState, frames: Iterator[tuple[int, int | None, Any]]
    ) -> Iterator[tuple[int, float, Any]]:
        """Yield number, time and picture of frames that have the right size, or no picture."""
        for number, pts, decoded in frames:
            state.last = number
            if decoded is not None and (decoded.width, decoded.height) != self._coded_wh:
                state.counts.other_size(number, (decoded.width, decoded.height))
            else:
                yield number, self._stamps.time_s(pts, number), decoded
        state.is_finished = True

    def _in_sequence(self, state: PassState, seek: KeyframeSeek | None) -> Iterator[tuple[int, int | None, Any]]:
        with self._open() as container:
            stream = self._stream(container)
            packets = self._packets(container, stream, state)
            if seek is not None:
                packets = seek.needed(packets, lambda packet: self._stamps.since_start_s(packet.pts))
            lost = LostFrames()
            if self._stamps.are_times and can_be_sparse(stream):
                packets = lost.noted(packets)
            for count, decoded in enumerate(self._decode(packets, stream, state.counts)):
                if seek is None or not seek.is_leading(decoded.pts):
                    count += lost.count(decoded.pts, is_damaged=state.counts.has_damage)
                    yield count + (seek.skipped_packets if seek is not None else 0), decoded.pts, decoded

    def _sparse(self, state: PassState, chooser: FrameChooser) -> Iterator[tuple[int, int, Any]]:
        with self._open() as container:
            stream = self._stream(container)
            if not can_be_sparse(stream):
                raise NotSparseError
            packets = _until_broken(self._packets(container, stream, state), state.counts)
            yield from SparseDecoder(stream.codec_context, chooser).frames(packets)

    def _packets(self, container: Any, stream: Any, state: PassState) -> Iterator[Any]:
        packets: Iterator[Any] = container.demux(stream)
        if self._stamps.are_times:
            state.carry = ClockCarry(self._stamps.base_s or 1.0, 1 / self.fps if self.fps else 0.04)
            packets = state.carry.carried(packets)
        return packets

    def _probe(self, container: Any, stream: Any) -> tuple[Any, list[int]]:
        """Return the first frame that can be decoded, and the stamps of the first packets."""
        stamps: list[int] = []

        def noted() -> Iterator[Any]:
            for packet in container.demux(stream):
                if packet.pts is not None:
                    stamps.append(packet.pts)
                yield packet

        packets = noted()
        first = next(self._decode(packets, stream, ProblemCounts()), None)
        if first is None:
            raise DataError(f"{self.path}: no frame of it can be decoded; the file is damaged or cut off")
        with contextlib.suppress(FFmpegError, EOFError):
            for _ in islice(packets, max(0, _PROBE_PACKETS - len(stamps))):
                pass
        return first, stamps

    def _open(self) -> AbstractContextManager[Any]:
        try:
            container: AbstractContextManager[Any] = av.open(
                self._ffmpeg_name, options=_OPEN_OPTIONS, metadata_errors="replace"
            )
        except (av.error.InvalidDataError, av.error.ArgumentError):
            raise DataError(f"{self.path}: {why_unreadable(self.path)}") from None
        except FFmpegError as error:
            reason = (error.strerror or type(error).__name__).lower()
            raise DataError(f"{self.path}: the video cannot be opened ({reason})") from None
        return container

    def _stream(self, container: Any) -> Any:
        streams = _real_streams(container)
        if not streams:
            kinds = ", ".join(sorted({s.type for s in container.streams}))
            if not kinds:
                raise DataError(f"{self.path}: {why_unreadable(self.path)}")
            raise DataError(f"{self.path}: it holds no video stream ({kinds} streams only)")
        wanted = self._wanted_stream
        if wanted is not None and not 0 <= wanted < len(streams):
            numbers = "0" if len(streams) == 1 else f"0 to {len(streams) - 1}"
            raise DataError(f"stream {wanted}: {self.path} has video streams {numbers}", parameter="stream")
        stream = streams[wanted] if wanted is not None else max(streams, key=pixel_count)
        if stream.codec_context is None:
            raise DataError(f"{self.path}: its video codec is not known to this FFmpeg; convert the file to H.264")
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = self._threads
        return stream

    def _decode(self, packets: Iterator[Any], stream: Any, counts: ProblemCounts) -> Iterator[Any]:
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
        return self._geometry.apply(image)

    def _grey(self, decoded: Any, factor: int) -> NDArray[np.uint8] | None:
        """Return the decoder's luma, downscaled and in full range; None where it has no luma plane of 8 bits."""
        if decoded.format.name not in _LUMA_FORMATS:
            return None
        plane = decoded.planes[0]
        grey = np.frombuffer(plane, dtype=np.uint8).reshape(-1, plane.line_size)[: decoded.height, : decoded.width]
        if self._geometry.resamples:
            grey = self._geometry.apply(np.ascontiguousarray(grey))
        grey = downscale(grey, factor)
        if decoded.color_range != _FULL_RANGE and not decoded.format.name.startswith("yuvj"):
            grey = np.asarray(cv2.LUT(grey, _TO_FULL_RANGE), dtype=np.uint8)
        return grey if self._geometry.resamples else self._geometry.apply(grey)


def _until_broken(packets: Iterator[Any], counts: ProblemCounts) -> Iterator[Any]:
    """Yield packets up to where the file cannot be read, which is counted."""
    try:
        yield from packets
    except (FFmpegError, EOFError) as error:
        counts.end = getattr(error, "strerror", None) or "unreadable data"


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


def _real_streams(container: Any) -> list[Any]:
    """Return the video streams that are no cover pictures."""
    pictures = av.stream.Disposition.attached_pic
    return [stream for stream in container.streams.video if not stream.disposition & pictures]
