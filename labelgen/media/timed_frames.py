"""Frames with time stamps, up to a duration, read ahead in a thread: the input of speed measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from labelgen.errors import DataError
from labelgen.media.frames import Frame, FrameSource, always
from labelgen.media.prefetch import prefetch

__all__ = ["TimedFrames"]

_FRAMES_AHEAD = 6


class TimedFrames:
    """A `labelgen.media.frames.FrameSource` around another one.

    Args:
        frames: a file, a folder or a stream.
        fps: frame rate for frames that have no time stamps of their own; None where none is known.
        duration_s: length of the recording's beginning to use, s, not counting its gaps; None takes all.
        lead_in: called once with the iterator of frames before the first one is yielded; frames it consumes are not
            yielded. This is how a background model is primed on a stream, which cannot be read twice.
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
        """Name of the source."""
        return self._frames.name

    @property
    def path(self) -> Path:
        """Path of the source."""
        return self._frames.path

    @property
    def size_wh(self) -> tuple[int, int]:
        """Size of the frames, px."""
        return self._frames.size_wh

    @property
    def frame_count(self) -> int | None:
        """Number of frames to expect; None where it is unknown."""
        count = self._frames.frame_count
        if self._duration_s is None or self.fps is None:
            return count
        limit = round(self._duration_s * self.fps)
        return limit if count is None else min(count, limit)

    @property
    def count_is_exact(self) -> bool:
        """Whether the source states its number of frames itself."""
        return self._frames.count_is_exact

    @property
    def untimed(self) -> str:
        """Why frames have no times; empty with a frame rate."""
        return "" if self.fps else self._frames.untimed

    @property
    def notes(self) -> list[str]:
        """Notes of the source."""
        return self._frames.notes

    @property
    def problems(self) -> list[str]:
        """Problems of the source."""
        return self._frames.problems

    @property
    def is_live(self) -> bool:
        """Whether the source is live."""
        return self._frames.is_live

    @property
    def failure(self) -> Exception | None:
        """Failure of the source."""
        return self._frames.failure

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """Return the wanted frames with their times; see `FrameSource.frames`.

        Raises:
            DataError: the frames have no time stamps and no frame rate is known.
        """
        return prefetch(self._timed(wanted), _FRAMES_AHEAD)

    def _timed(self, wanted: Callable[[int], bool]) -> Iterator[Frame]:
        frames = self._frames.frames(wanted)
        if self._lead_in is not None:
            self._lead_in(frames)
        for frame in frames:
            if not np.isfinite(frame.time_s):
                if self.fps is None:
                    raise DataError(
                        f"{self._frames.path}: {self._frames.untimed or 'a frame has no time stamp'}, so there are "
                        "no speeds; give fps",
                        parameter="fps",
                    )
                frame = Frame(frame.number, frame.number / self.fps, frame.image, frame.name)
            if self._duration_s is not None and frame.shown_s >= self._duration_s:
                return
            yield frame
