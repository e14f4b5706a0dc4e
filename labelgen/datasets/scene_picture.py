"""Read one picture of a scene: its empty road, or a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labelgen.datasets.scene import SceneFiles
from labelgen.errors import DataError
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.image_file import read_image
from labelgen.media.sparse_frames import sparse_frames

__all__ = ["read_picture"]

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def read_picture(scene: SceneFiles, frame: int = 0) -> NDArray[np.uint8]:
    """Read a picture of a scene: an image file, a session's picture of the empty road, or a frame.

    Args:
        scene: the scene.
        frame: number of the frame. Frame 0 is replaced by the picture of the empty road, where there is one.

    Returns:
        (H, W, 3) uint8 BGR.

    Raises:
        DataError: there is no such frame, or no picture at all.
    """
    path = scene.picture_path
    if path is not None and path.suffix.lower() in _IMAGE_SUFFIXES and (frame == 0 or path == scene.frames_path):
        return read_image(path)
    if scene.frames_path is None and path is not None:
        raise DataError(f"{scene.name}: frame {frame} needs its video, which is not there; frame 0 is its empty road")
    if scene.frames_path is None:
        raise DataError(f"{scene.name}: it has neither a video nor a picture of the empty road")
    for wanted in sparse_frames(scene.open_frames(), FrameChoice(wanted=frame.__eq__, limit=frame + 1)):
        return wanted.image
    raise DataError(f"{scene.frames_path}: it has no frame {frame}")
