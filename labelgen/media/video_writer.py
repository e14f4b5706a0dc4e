"""Write a video that stays playable when the writing is interrupted.

An AVI file without B-frames holds complete frames in the order they were written; players find them even when the
index at the end is missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import as_output_error
from labelgen.errors import OutputError
from labelgen.media.container.file_names import ffmpeg_name

__all__ = ["VideoWriter"]

# Without adaptive quantisation the encoder spends no bits on the noise of an even road, as cameras' own encoders do.
# There are no scene cuts to detect. Both take less time and half the space.
_X264_PARAMETERS = "aq-mode=0:weightp=0:scenecut=0"


def _codecs(crf: int, preset: str) -> tuple[tuple[str, dict[str, str]], ...]:
    return (
        ("libx264", {"crf": str(crf), "preset": preset, "bf": "0", "threads": "1", "x264-params": _X264_PARAMETERS}),
        ("mpeg4", {"qscale": str(max(2, (crf - 12) // 3)), "bf": "0"}),
    )


class VideoWriter:
    """Context manager that encodes BGR frames into an AVI file: H.264, or MPEG-4 where that is missing.

    Args:
        path: ends in .avi.
        fps: frames per second.
        size_wh: width and height of the frames, px; both even.
        crf: constant rate factor of H.264; lower means better quality and more bytes.
        preset: speed preset of H.264; slower presets take fewer bytes for the same quality.

    Raises:
        OutputError: the file cannot be written, or the width or height is odd.
    """

    def __init__(
        self, path: Path, fps: float, size_wh: tuple[int, int], crf: int = 21, *, preset: str = "superfast"
    ) -> None:
        import av

        if size_wh[0] % 2 or size_wh[1] % 2:
            raise OutputError(
                f"size {size_wh[0]}x{size_wh[1]}: video frames need an even width and height", parameter="size_wh"
            )
        codecs = _codecs(crf, preset)
        name, options = next((codec for codec in codecs if codec[0] in av.codecs_available), codecs[-1])
        self._av, self._count, self._path = av, 0, path
        with self._named_errors():
            self._container = av.open(ffmpeg_name(path), "w", format="avi")
        rate = Fraction(fps).limit_denominator(1001)
        stream: Any = self._container.add_stream(name, rate=rate, options=options)
        stream.width, stream.height = size_wh
        stream.pix_fmt = "yuv420p"
        stream.codec_context.gop_size = max(1, round(fps))
        stream.codec_context.thread_count = 1
        self._stream = stream

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame (H, W, 3) uint8 BGR.

        Raises:
            OutputError: the file cannot be written.
        """
        planes = cv2.cvtColor(frame, cv2.COLOR_BGR2YUV_I420)
        picture = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        picture.pts = self._count
        self._count += 1
        with self._named_errors():
            for packet in self._stream.encode(picture):
                self._container.mux(packet)

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Turn errors of the system and of FFmpeg into an OutputError that names the file."""
        try:
            with as_output_error(self._path):
                yield
        except self._av.error.FFmpegError as err:
            raise OutputError(f"cannot write {self._path}: {err.strerror or err}") from None

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with self._named_errors():
                for packet in self._stream.encode(None):
                    self._container.mux(packet)
                self._container.close()
        except OutputError:
            if kind is None:  # an error that ended the block is the cause
                raise
