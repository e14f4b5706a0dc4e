"""Open a video file or a folder of images with the reader that fits."""

from __future__ import annotations

from pathlib import Path

from labelgen.errors import DataError
from labelgen.media.frames import FrameSource
from labelgen.media.image_folder import ImageFolder
from labelgen.media.video_reader import VideoFile

__all__ = ["open_frames"]


def open_frames(
    path: str | Path, *, threads: int = 0, fps: float | None = None, stream: int | None = None
) -> FrameSource:
    """Open a video file or a folder of images.

    Args:
        path: video file in any format FFmpeg reads, or a folder with *.jpg, *.png, *.bmp, *.tif or *.webp files.
        threads: decoding threads for a video; 0 leaves it to the decoder.
        fps: frames per second, for frames without time stamps that can be trusted.
        stream: number of the video stream to use, from 0; None takes the largest.

    Raises:
        DataError: there is no such file or folder, or no frame in it can be read.
    """
    path = Path(path)
    if path.is_dir():
        return ImageFolder(path, fps=fps)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; give a video file or a folder of images")
    return VideoFile(path, threads=threads, fps=fps, stream=stream)
