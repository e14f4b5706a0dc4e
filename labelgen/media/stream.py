"""Camera streams: frames from a URL, read once, until the stream ends.

Unlike a file, a stream cannot be read again, has no length, may stop sending without ending, and may change its
resolution while it runs. `VideoStream.failure` says afterwards why an iteration broke off.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Callable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import ExitError, FFmpegError

from labelgen.errors import DataError
from labelgen.media.container.deinterlace import DEINTERLACED, deinterlaced
from labelgen.media.container.file_stamps import STAMP_RULES, STAMPLESS_FORMATS
from labelgen.media.container.frame_clock import ArrivalClock, FrameClock
from labelgen.media.container.frame_geometry import FrameGeometry
from labelgen.media.container.video_tracks import INTERLACED, display_matrix, pixel_count, stream_note
from labelgen.media.frames import Frame, always
from labelgen.media.prefetch import prefetch
from labelgen.output_names import folder_name
from labelgen.problem_counts import count_of

__all__ = ["VideoStream", "is_stream_url"]

_PROTOCOLS = ("http", "https", "rtsp", "rtmp", "rtp", "udp", "tcp", "srt")
# The protocols and what they are built on. The file system is not among them.
_OPEN_OPTIONS = {"protocol_whitelist": ",".join([*_PROTOCOLS, "tls", "httpproxy", "crypto"]), "rtsp_transport": "tcp"}

# Frames decoded to see the frame rate before any is handed out.
_PROBE_FRAMES = 8
# Packets kept while frames are worked on, in a stream whose frames are timed by their arrival.
_PACKETS_AHEAD = 500


def stream_name(url: str) -> str:
    """Return the name of a stream for its results: the last part of its address, without an extension."""
    last = url.rsplit("/", 1)[-1].split("?")[0] or "stream"
    return folder_name(re.sub(r"[^A-Za-z0-9_.-]+", "_", Path(last).stem), "stream")


def is_stream_url(source: str) -> bool:
    """Return whether a source is a URL of a protocol that FFmpeg reads over the network."""
    match = re.match(r"([a-z]+)://", source.lower())
    return match is not None and match[1] in _PROTOCOLS


class VideoStream:
    """A camera stream as a `labelgen.media.frames.FrameSource` that can be iterated once.

    Frames have the times of their stamps. In a stream without stamps of its own they have those of their arrival,
    smoothed. Frames that the camera or the network drops leave a jump in the times and are counted in `problems`.

    Args:
        url: of protocol http, https, rtsp, rtmp, rtp, udp, tcp or srt.
        duration_s: stop after this much of the stream, or after waiting that long, s; None reads until it ends.
        stall_s: time without data after which the stream counts as stalled, s.
        fps: frames per second, for a stream without time stamps; None measures it from the arrivals.
        stream: number of the video stream to use, from 0; None takes the largest.
        deinterlace: whether each frame is deinterlaced.

    Attributes:
        failure: the error that broke off the last iteration; None where the stream was left on time, or where it
            ended as its protocol says it ends.

    Raises:
        DataError: nothing answers at the address, or it sends no (or not this) video.
    """

    frame_count: int | None = None
    count_is_exact = False
    is_live = True
    untimed = ""

    def __init__(
        self,
        url: str,
        *,
        duration_s: float | None = None,
        stall_s: float = 10.0,
        fps: float | None = None,
        stream: int | None = None,
        deinterlace: bool = False,
    ) -> None:
        self.url, self.path = url, Path(url.rsplit("/", 1)[-1].split("?")[0] or "stream")
        self.name = stream_name(url)
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.failure: Exception | None = None
        self._duration_s, self._stall_s = duration_s, stall_s
        self._started_s = time.monotonic()
        try:
            self._container: Any = av.open(url, options=_OPEN_OPTIONS, timeout=(stall_s, stall_s))
        except ExitError:
            raise DataError(f"stream {url}: no answer for {stall_s:g} s; check the address and the camera") from None
        except FFmpegError as error:
            raise DataError(f"stream {url}: cannot be opened ({_reason(error)}); check the address") from None
        video = self._video(stream)
        video.thread_type = "AUTO"
        self._base_s = float(video.time_base) if video.time_base else math.nan
        self._by_arrival = self._base_s != self._base_s or bool(
            set(self._container.format.name.split(",")) & STAMPLESS_FORMATS
        )
        announced = float(video.average_rate or video.guessed_rate or 0) or None
        self._decoded = self._decode(video)
        held = list(islice(self._decoded, 1 if self._by_arrival else _PROBE_FRAMES))
        if not held:
            self._container.close()
            raise self.failure or DataError(f"stream {url}: it ended before its first frame")
        self._held, self._begun = held, False
        first = held[0][1]
        self._by_arrival |= first.pts is None
        self.fps = fps if self._by_arrival else _believed(announced, held, self._base_s) or fps
        self._coded_wh = (int(first.width), int(first.height))
        self._geometry = FrameGeometry.of(self._coded_wh, video.sample_aspect_ratio, display_matrix(first))
        self.size_wh = self._geometry.size_wh
        if self._geometry.note:
            self.notes.append(self._geometry.note)
        self._deinterlace = deinterlace
        if deinterlace or first.interlaced_frame:
            self.notes.append(DEINTERLACED if deinterlace else INTERLACED)
        if self._by_arrival:
            way = "by their arrival" if fps is None else f"at the given {fps:g} per second"
            self.notes.append(f"the stream has no time stamps: frames are timed {way}")
        elif fps and self.fps and abs(fps - self.fps) > STAMP_RULES.given_rate * fps:
            self.notes.append(
                f"the stream has time stamps of its own, {self.fps:.4g} per second; the given {fps:g} is not used"
            )
        self._clock: ArrivalClock | FrameClock = (
            ArrivalClock(fps) if self._by_arrival else FrameClock(1 / self.fps if self.fps else None)
        )

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """Return the wanted frames; see `FrameSource.frames`. It can be called once.

        Raises:
            DataError: it is called again.
        """
        if self._begun:
            raise DataError(f"stream {self.url}: it can be read only once")
        self._begun = True
        latest, dropped, count = 0.0, 0, 0
        try:
            items = self._clock.timed(self._stamped())
            for number, time_s, gaps_s, decoded in deinterlaced(items) if self._deinterlace else items:
                count = number + 1
                if (decoded.width, decoded.height) != self._coded_wh:
                    new, old = ("{}x{}".format(*wh) for wh in ((decoded.width, decoded.height), self._coded_wh))
                    self.failure = DataError(
                        f"stream {self.url}: its resolution changed from {old} to {new} at frame {number} "
                        f"({time_s:.1f} s); the calibration no longer fits, so measuring ended there"
                    )
                    return
                if self.fps and time_s - latest > 1.5 / self.fps:
                    dropped += round((time_s - latest) * self.fps) - 1
                latest = time_s
                if self._is_over(time_s - gaps_s):
                    self.failure = None  # what came after the time that was asked for does not matter
                    return
                if wanted(number):
                    image = np.ascontiguousarray(decoded.to_ndarray(format="bgr24"))
                    yield Frame(number, time_s, self._geometry.apply(image), "", gaps_s)
            if self.failure is None and self._duration_s is not None:
                self.problems.append(f"the stream ended after {latest:.1f} s, {count} frames")
        finally:
            if dropped and not self._by_arrival:
                self.problems.append(f"about {dropped} frames were dropped on the way; time stamps make up for them")
            self.problems += self._clock.problems()
            if isinstance(self._clock, ArrivalClock):
                self.fps = self._clock.fps
            # A reader that still waits for data owns the container.
            if not self._by_arrival:
                self._container.close()

    def _stamped(self) -> Iterator[tuple[int, float, Any]]:
        """Yield number, time stamp or moment of arrival in s, and decoder's frame."""
        frames = enumerate(chain(self._held, self._decoded))
        for number, (arrival_s, decoded) in frames:
            if self._by_arrival:
                yield number, arrival_s, decoded
            else:
                yield number, math.nan if decoded.pts is None else float(decoded.pts * self._base_s), decoded

    def _video(self, wanted: int | None) -> Any:
        streams = [stream for stream in self._container.streams.video if stream.codec_context is not None]
        if not streams:
            self._container.close()
            raise DataError(f"stream {self.url}: there is no video in it")
        if wanted is not None and not 0 <= wanted < len(streams):
            self._container.close()
            raise DataError(f"stream {wanted}: {self.url} has {len(streams)} video streams", parameter="stream")
        video = streams[wanted] if wanted is not None else max(streams, key=pixel_count)
        if len(streams) > 1:
            self.notes.append(stream_note(len(streams), streams.index(video), video, chosen=wanted is not None))
        return video

    def _is_over(self, time_s: float) -> bool:
        if self._duration_s is None:
            return False
        waited = time.monotonic() - self._started_s
        # The time stamps of a stream that sends too slowly would never reach the end.
        return time_s >= self._duration_s or waited > self._duration_s + self._stall_s

    def _arriving(self, stream: Any) -> Iterator[tuple[float, Any]]:
        """Yield packets with the moment at which they came."""
        for packet in self._container.demux(stream):
            yield time.monotonic(), packet

    def _decode(self, stream: Any) -> Iterator[tuple[float, Any]]:
        """Yield decoded frames with the moment of arrival; keep in `failure` what broke the stream off."""
        damaged, count = 0, 0
        packets = self._arriving(stream)
        if self._by_arrival:
            # Read at once what comes: a frame that waits to be read would count as one that came late.
            packets = prefetch(packets, _PACKETS_AHEAD)
        while True:
            try:
                arrival_s, packet = next(packets, (0.0, None))
            except ExitError:
                self.failure = DataError(f"stream {self.url}: stalled, no data for {self._stall_s:g} s {_after(count)}")
                break
            except (FFmpegError, EOFError) as error:
                reason = _reason(error) if isinstance(error, FFmpegError) else "unreadable data"
                self.failure = DataError(f"stream {self.url}: the connection broke off {_after(count)} ({reason})")
                break
            if packet is None:
                # HTTP says how a transfer ends, and FFmpeg reports one that is cut short as an error.
                if not self.url.lower().startswith("http"):
                    self.failure = DataError(f"stream {self.url}: the connection was closed {_after(count)}")
                break
            try:
                decoded = packet.decode()
            except (FFmpegError, EOFError):
                damaged += 1
                continue
            for frame in decoded:
                count += 1
                yield arrival_s, frame
        with contextlib.suppress(FFmpegError, EOFError):
            for frame in stream.codec_context.decode(None):  # what the decoder still holds
                yield time.monotonic(), frame
        if damaged:
            self.problems.append(f"{count_of(damaged, 'damaged packet')} skipped")


def _after(count: int) -> str:
    return f"after {count_of(count, 'frame')}"


def _believed(announced: float | None, held: list[tuple[float, Any]], base_s: float) -> float | None:
    """Return the announced frame rate, or that of the first frames' stamps where it is another one."""
    stamps = sorted(frame.pts for _, frame in held if frame.pts is not None)
    steps = np.diff(stamps)
    if len(steps) < 2:
        return announced
    rates = [1 / (float(step) * base_s) for step in (np.median(steps), np.mean(steps)) if step > 0]
    if announced and any(abs(announced - rate) <= STAMP_RULES.same_rate * rate for rate in rates):
        return announced
    return rates[0] if rates and STAMP_RULES.min_fps <= rates[0] <= STAMP_RULES.max_fps else announced


def _reason(error: FFmpegError) -> str:
    return (error.strerror or type(error).__name__).lower()
