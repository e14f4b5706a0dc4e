"""Camera streams: frames from a URL, read once, until the stream ends.

Unlike a file, a stream cannot be read again, has no length, may stop sending without ending, and may change its
resolution while it runs. `VideoStream.failure` says afterwards why an iteration broke off.
"""

from __future__ import annotations

import itertools
import math
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import ExitError, FFmpegError
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.media.frames import Frame, always

__all__ = ["VideoStream", "is_stream_url"]

_PROTOCOLS = ("http", "https", "rtsp", "rtmp", "rtp", "udp", "tcp", "srt")
# The protocols and what they are built on. The file system is not among them.
_OPEN_OPTIONS = {"protocol_whitelist": ",".join([*_PROTOCOLS, "tls", "httpproxy", "crypto"]), "rtsp_transport": "tcp"}


def is_stream_url(source: str) -> bool:
    """Return whether a source is a URL of a protocol that FFmpeg reads over the network."""
    match = re.match(r"([a-z]+)://", source.lower())
    return match is not None and match[1] in _PROTOCOLS


class VideoStream:
    """A camera stream as a `labelgen.media.frames.FrameSource` that can be iterated once.

    Frames that the camera or the network drops leave a jump in the time stamps and are counted in `problems`.

    Args:
        url: of protocol http, https, rtsp, rtmp, rtp, udp, tcp or srt.
        duration_s: stop after this much of the stream, or after waiting that long, s; None reads until it ends.
        stall_s: time without data after which the stream counts as stalled, s.

    Attributes:
        failure: the error that broke off the last iteration; None where the stream ended or was left on time.

    Raises:
        DataError: nothing answers at the address, or it sends no video.
    """

    frame_count: int | None = None
    is_live = True

    def __init__(self, url: str, *, duration_s: float | None = None, stall_s: float = 10.0) -> None:
        self.url, self.path = url, Path(url.rsplit("/", 1)[-1].split("?")[0] or "stream")
        self.name = re.sub(r"[^A-Za-z0-9_.-]+", "_", self.path.stem) or "stream"
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
        if not self._container.streams.video:
            self._container.close()
            raise DataError(f"stream {url}: there is no video in it")
        stream = self._container.streams.video[0]
        stream.thread_type = "AUTO"
        self._base = float(stream.time_base) if stream.time_base else math.nan
        self.fps = float(stream.average_rate or stream.guessed_rate or 0) or None
        self._decoded = self._decode(stream)
        first = next(self._decoded, None)
        if first is None:
            self._container.close()
            raise self.failure or DataError(f"stream {url}: it ended before its first frame")
        self._first, self._begun = first, False
        self.size_wh = (int(first.width), int(first.height))

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
        number, latest, dropped = -1, 0.0, 0
        try:
            for number, decoded in enumerate(itertools.chain([self._first], self._decoded)):
                time_s = self._time(decoded, number)
                if (decoded.width, decoded.height) != self.size_wh:
                    new, old = ("{}x{}".format(*wh) for wh in ((decoded.width, decoded.height), self.size_wh))
                    self.failure = DataError(
                        f"stream {self.url}: its resolution changed from {old} to {new} at frame {number} "
                        f"({time_s:.1f} s); the calibration no longer fits, so measuring ended there"
                    )
                    return
                if self.fps and time_s - latest > 1.5 / self.fps:
                    dropped += round((time_s - latest) * self.fps) - 1
                latest = max(latest, time_s)
                if self._is_over(time_s):
                    return
                if wanted(number):
                    yield Frame(number, time_s, _image(decoded))
            if self.failure is None and self._duration_s is not None:
                self.problems.append(f"the stream ended after {latest:.1f} s, {number + 1} frames")
        finally:
            if dropped:
                self.problems.append(f"about {dropped} frames were dropped on the way; time stamps make up for them")
            self._container.close()

    def _time(self, decoded: Any, number: int) -> float:
        if decoded.pts is None or self._first.pts is None or math.isnan(self._base):
            return number / self.fps if self.fps else math.nan
        return float((decoded.pts - self._first.pts) * self._base)

    def _is_over(self, time_s: float) -> bool:
        if self._duration_s is None:
            return False
        waited = time.monotonic() - self._started_s
        # The time stamps of a stream that sends too slowly would never reach the end.
        return time_s >= self._duration_s or waited > self._duration_s + self._stall_s

    def _decode(self, stream: Any) -> Iterator[Any]:
        """Yield decoded frames; skip damaged packets, and keep in `failure` what broke the stream off."""
        damaged, decoded_count = 0, 0
        packets = self._container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
            except ExitError:
                self.failure = DataError(
                    f"stream {self.url}: stalled, no data for {self._stall_s:g} s after {decoded_count} frames"
                )
                break
            except (FFmpegError, EOFError):
                break  # many streams end with a closed connection
            if packet is None:
                break
            try:
                decoded = packet.decode()
            except (FFmpegError, EOFError):
                damaged += 1
                continue
            for frame in decoded:
                decoded_count += 1
                yield frame
        if damaged:
            self.problems.append(f"{damaged} damaged packets skipped")


def _reason(error: FFmpegError) -> str:
    return (error.strerror or type(error).__name__).lower()


def _image(decoded: Any) -> NDArray[np.uint8]:
    image: NDArray[np.uint8] = np.ascontiguousarray(decoded.to_ndarray(format="bgr24"))
    return image
