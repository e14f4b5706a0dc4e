"""Reading one image file or one encoded image, whatever is wrong with it.

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


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR, *, what: str = "") -> NDArray[Any]:
    """An image file's pixels.

    Args:
        path: of any form; OpenCV itself neither opens every path a file system allows nor keeps quiet when it cannot.
        flags: OpenCV's `IMREAD_...`, which decide shape and dtype.
        what: what to call it in an error; its path by default.

    Raises:
        DataError: not there, or no image.
    """
    what = what or str(path).encode("utf-8", "backslashreplace").decode()
    try:
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as err:
        raise DataError(f"{what}: {err.strerror or err}") from None
    except ValueError:  # NUL or half a character in it
        raise DataError(f"{what}: its path is no file's name") from None
    return decode_image(encoded, what, flags)


def decode_image(encoded: NDArray[np.uint8], what: str, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """The pixels of an image in memory.

    Args:
        encoded: (N,) bytes of an image file.
        what: what to call it in an error.
        flags: OpenCV's `IMREAD_...`, which decide shape and dtype.

    Raises:
        DataError: no image.
    """
    # OpenCV would print what the error says; libpng and libjpeg print on their own and cannot be stopped here.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(encoded, flags) if encoded.size else None
    except cv2.error:  # for instance more pixels announced than OpenCV allows
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise DataError(f"{what}: not an image")
    return np.asarray(image)
