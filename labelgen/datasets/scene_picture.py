"""One picture of a scene: its empty road, or a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.scene import SceneFiles
from labelgen.errors import DataError
from labelgen.media.image_file import read_image
from labelgen.media.open_frames import open_frames

__all__ = ["read_picture"]

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def read_picture(scene: SceneFiles, frame: int = 0) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR: an image file as it is, a session's picture of the empty road, or a frame.

    Args:
        scene: what to show.
        frame: number of the frame; other than 0 it is always taken from the video.

    Raises:
        DataError: no such frame or no picture.
    """
    path = scene.picture_path
    if path is not None and path.suffix.lower() in _IMAGE_SUFFIXES and (frame == 0 or path == scene.frames_path):
        return read_image(path)
    if scene.frames_path is None and path is not None:
        raise DataError(f"{scene.name}: frame {frame} needs its video, which is not there; frame 0 is its empty road")
    if scene.frames_path is None:
        raise DataError(f"{scene.name}: it has neither a video nor a picture of the empty road")
    for found in open_frames(scene.frames_path).frames(lambda n: n == frame):
        return found.image
    raise DataError(f"{scene.frames_path}: it has no frame {frame}")
