"""Read one image file or one encoded image; every defect of it becomes a `DataError`.

Convention: colour images are (H, W, 3) uint8 BGR.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError

__all__ = ["decode_image", "read_image"]


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR, *, label: str = "") -> NDArray[Any]:
    """Read an image file.

    Args:
        path: any path that the file system allows; OpenCV's own reader opens only some of them.
        flags: OpenCV's `IMREAD_...`, which decide shape and dtype.
        label: name of the image in errors; its path by default.

    Returns:
        (H, W, 3) uint8 BGR with the default flags.

    Raises:
        DataError: there is no such file, or it is not an image.
    """
    label = label or str(path).encode("utf-8", "backslashreplace").decode()
    try:
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as err:
        raise DataError(f"{label}: {err.strerror or err}") from None
    except ValueError:  # the path holds NUL or half a surrogate pair
        raise DataError(f"{label}: its path is no file's name") from None
    return decode_image(encoded, label, flags)


def decode_image(encoded: NDArray[np.uint8], label: str, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Decode an image in memory.

    Args:
        encoded: (N,) bytes of an image file.
        label: name of the image in errors.
        flags: OpenCV's `IMREAD_...`, which decide shape and dtype.

    Returns:
        (H, W, 3) uint8 BGR with the default flags.

    Raises:
        DataError: the bytes are not an image.
    """
    # Keep OpenCV from printing what the error says. Messages of libpng and libjpeg cannot be suppressed here.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(encoded, flags) if encoded.size else None
    except cv2.error:  # for instance, the header announces more pixels than OpenCV allows
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise DataError(f"{label}: not an image")
    return np.asarray(image)
