"""Frames with time stamps, up to a duration, read ahead in a thread: what speeds are measured on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from labelgen.errors import DataError
from labelgen.media.frames import Frame, FrameSource, always
from labelgen.media.prefetch import prefetch

__all__ = ["TimedFrames"]

_AHEAD = 6


class TimedFrames:
    """A `labelgen.media.frames.FrameSource` around another one.

    Args:
        frames: a file, a folder or a stream.
        fps: frame rate for frames that have no time stamps of their own; None where none is known.
        duration_s: leave out what comes after this many seconds; None takes all.
        lead_in: called with the coming frames before the first one is given; what it takes of them is not given.
            Streams, which cannot be begun anew, let a background model learn this way.
    """

    def __init__(
        self,
        frames: FrameSource,
        *,
        fps: float | None = None,
        duration_s: float | None = None,
        lead_in: Callable[[Iterator[Frame]], None] | None = None,
    ) -> None:
        self._frames, self.fps, self._duration_s, self._lead_in = frames, fps, duration_s, lead_in

    @property
    def name(self) -> str:
        """That of the source."""
        return self._frames.name

    @property
    def path(self) -> Path:
        """That of the source."""
        return self._frames.path

    @property
    def size_wh(self) -> tuple[int, int]:
        """Size of its frames, px."""
        return self._frames.size_wh

    @property
    def frame_count(self) -> int | None:
        """How many frames are to be expected; None where that is not known."""
        count = self._frames.frame_count
        if self._duration_s is None or self.fps is None:
            return count
        most = round(self._duration_s * self.fps)
        return most if count is None else min(count, most)

    @property
    def problems(self) -> list[str]:
        """Those of the source."""
        return self._frames.problems

    @property
    def is_live(self) -> bool:
        """That of the source."""
        return self._frames.is_live

    @property
    def failure(self) -> Exception | None:
        """That of the source."""
        return self._frames.failure

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """The wanted frames with their times; see `FrameSource.frames`.

        Raises:
            DataError: they have no time stamps, and no frame rate is known.
        """
        return prefetch(self._timed(wanted), _AHEAD)

    def _timed(self, wanted: Callable[[int], bool]) -> Iterator[Frame]:
        coming = self._frames.frames(wanted)
        if self._lead_in is not None:
            self._lead_in(coming)
        for frame in coming:
            if not np.isfinite(frame.time_s):
                if self.fps is None:
                    raise DataError(
                        f"{self._frames.path}: its frames have no time stamps, so there are no speeds; give --fps"
                    )
                frame = Frame(frame.number, frame.number / self.fps, frame.image, frame.name)
            if self._duration_s is not None and frame.time_s >= self._duration_s:
                return
            yield frame
