"""Open a video file or a folder of images with the reader that fits."""

from __future__ import annotations

from pathlib import Path

from labelgen.errors import DataError
from labelgen.media.frames import FrameSource
from labelgen.media.image_folder import ImageFolder
from labelgen.media.video_reader import VideoFile

__all__ = ["open_frames"]


def open_frames(
    path: str | Path,
    *,
    threads: int = 0,
    fps: float | None = None,
    stream: int | None = None,
    deinterlace: bool = False,
) -> FrameSource:
    """Open a video file or a folder of images.

    Args:
        path: video file in any format FFmpeg reads, or a folder with *.jpg, *.png, *.bmp, *.tif or *.webp files.
        threads: decoding threads for a video; 0 leaves it to the decoder.
        fps: frames per second, for frames without time stamps that can be trusted.
        stream: number of the video stream to use, from 0; None takes the largest.
        deinterlace: whether each frame of a video is deinterlaced.

    Raises:
        DataError: there is no such file or folder, no frame in it can be read, or a folder is to be deinterlaced.
    """
    path = Path(path)
    if path.is_dir():
        if deinterlace:
            raise DataError(
                f"{path}: deinterlace is for videos; deinterlace the recording from which these images come",
                parameter="deinterlace",
            )
        return ImageFolder(path, fps=fps)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder; give a video file or a folder of images")
    return VideoFile(path, threads=threads, fps=fps, stream=stream, deinterlace=deinterlace)
