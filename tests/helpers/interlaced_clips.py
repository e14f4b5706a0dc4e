"""Interlaced recordings of a bar that moves, of which every whole frame is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np

SIZE_WH = (320, 180)


def bar(number: float) -> np.ndarray:
    """(180, 320, 3) uint8: the scene at the time of a frame, which may lie between two."""
    picture = np.full((SIZE_WH[1], SIZE_WH[0], 3), 90, np.uint8)
    left = round(20 + 16 * number)
    picture[40:140, left : left + 60] = 200
    return picture


def write_interlaced(path: Path, frames: int, fps: int) -> Path:
    """Write a video whose odd lines show each frame's time, and whose even ones half a frame later."""
    with av.open(str(path), "w", format={".ts": "mpegts"}.get(path.suffix)) as container:
        options = {"x264-params": "bff=1", "crf": "12", "bf": "0"}
        stream: Any = container.add_stream("libx264", rate=fps, options=options)
        stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuv420p"
        for number in range(frames):
            picture = bar(number)
            picture[::2] = bar(number + 0.5)[::2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    return path
