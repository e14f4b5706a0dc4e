"""What a container and its frames say about themselves, for files and streams alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["INTERLACED", "display_matrix", "pixel_count", "stream_note"]

INTERLACED = "its frames are interlaced: moving edges are torn; for exact results set deinterlace"


def display_matrix(decoded: Any) -> NDArray[np.float64] | None:
    """Return the (3, 3) display matrix of a decoder's frame; None where it has none."""
    for data in decoded.side_data:
        if data.type.name == "DISPLAYMATRIX":
            return np.frombuffer(data, dtype=np.int32, count=9).reshape(3, 3) / 65536.0
    return None


def pixel_count(stream: Any) -> int:
    """Return the number of pixels in a frame of a video stream; 0 where it is not known."""
    context = stream.codec_context
    return 0 if context is None else int(context.width * context.height)


def stream_note(count: int, number: int, stream: Any, *, chosen: bool) -> str:
    """Return in words which of several video streams is used.

    Args:
        count: how many there are.
        number: of the used one, from 0.
        stream: the used one.
        chosen: whether it was asked for.
    """
    size = f"{stream.codec_context.width}x{stream.codec_context.height}"
    return f"{count} video streams; {'' if chosen else 'the largest, '}number {number} (from 0) of {size} is used"
