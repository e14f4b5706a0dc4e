"""Read one image file or one encoded image; every defect of it becomes a `DataError`.

The header is read before the image is decoded: a small file may announce an image that fills the memory. How many
pixels are allowed can be raised by the environment variable `LABELGEN_MAX_PIXELS`.

Convention: colour images are (H, W, 3) uint8 BGR.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import write_atomic
from labelgen.errors import DataError, LabelgenError
from labelgen.media.image_header import image_size

__all__ = ["MAX_PIXELS_VARIABLE", "decode_image", "max_pixels", "read_image", "write_image"]

MAX_PIXELS_VARIABLE = "LABELGEN_MAX_PIXELS"
_MAX_PIXELS = 100_000_000
_MAX_BYTES_PER_PIXEL = 8


def write_image(path: Path, image: NDArray[np.uint8]) -> Path:
    """Write an image file, whole or not at all, and return its path.

    Args:
        path: its suffix says how the image is encoded.
        image: (H, W, 3) uint8 BGR or (H, W) uint8.

    Raises:
        OutputError: it cannot be written.
    """
    write_atomic(path, cv2.imencode(path.suffix.lower(), image)[1].tobytes())
    return path


def max_pixels() -> int:
    """Return the number of pixels an image may have: 100 million, or what `LABELGEN_MAX_PIXELS` says.

    Raises:
        LabelgenError: the variable is not a number of pixels.
    """
    text = os.environ.get(MAX_PIXELS_VARIABLE, "")
    if not text:
        return _MAX_PIXELS
    if not (text.isascii() and text.isdigit() and 0 < len(text) < 16):
        raise LabelgenError(f"{MAX_PIXELS_VARIABLE}={text[:40]}: expected a number of pixels, for instance 200000000")
    return int(text)


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR, *, label: str = "") -> NDArray[Any]:
    """Read an image file.

    Args:
        path: any path that the file system allows; OpenCV's own reader opens only some of them.
        flags: OpenCV's `IMREAD_...`, which decide shape and dtype.
        label: name of the image in errors; its path by default.

    Returns:
        (H, W, 3) uint8 BGR with the default flags.

    Raises:
        DataError: there is no such file, or it is not an image, or has more pixels than `max_pixels`.
    """
    label = label or str(path).encode("utf-8", "backslashreplace").decode()
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DataError(
                f"{label}: {'a folder' if stat.S_ISDIR(status.st_mode) else 'a pipe or device'}, not an image"
            )
        if status.st_size > _MAX_BYTES_PER_PIXEL * max_pixels():
            raise DataError(f"{label}: {status.st_size} bytes are too many for an image; {_advice()}")
        encoded = np.fromfile(path, dtype=np.uint8)
    except OSError as err:
        raise DataError(f"{label}: {err.strerror or err}") from None
    except ValueError:  # the path holds NUL or half a surrogate pair
        raise DataError(f"{label}: its path is no file's name") from None
    return decode_image(encoded, label, flags)


def decode_image(
    encoded: NDArray[np.uint8],
    label: str,
    flags: int = cv2.IMREAD_COLOR,
    *,
    expected_wh: tuple[int, int] | None = None,
) -> NDArray[Any]:
    """Decode an image in memory.

    Args:
        encoded: (N,) bytes of an image file.
        label: name of the image in errors.
        flags: OpenCV's `IMREAD_...`, which decide shape and dtype.
        expected_wh: width and height px that the image must have; None for any.

    Returns:
        (H, W, 3) uint8 BGR with the default flags.

    Raises:
        DataError: the bytes are not an image, or one of another size, or one of more pixels than `max_pixels`.
    """
    size_wh = image_size(np.ascontiguousarray(encoded).data.cast("B")) if encoded.size else None
    if size_wh is None:
        raise DataError(f"{label}: not an image")
    if expected_wh is not None and size_wh != tuple(expected_wh):
        raise DataError(
            f"{label}: its image is {size_wh[0]}x{size_wh[1]} px, expected {expected_wh[0]}x{expected_wh[1]}"
        )
    if size_wh[0] * size_wh[1] > max_pixels():
        raise DataError(f"{label}: {size_wh[0]}x{size_wh[1]} px are too many; {_advice()}")
    # Keep OpenCV from printing what the error says. Messages of libpng and libjpeg cannot be suppressed here.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(encoded, flags)
    except cv2.error:  # for instance, the header announces more pixels than OpenCV allows
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise DataError(f"{label}: not an image")
    result = np.asarray(image)
    if expected_wh is not None and result.shape[1::-1] != tuple(expected_wh):  # turned by the image's own orientation
        raise DataError(f"{label}: its image is turned; expected {expected_wh[0]}x{expected_wh[1]} px")
    return result


def _advice() -> str:
    return f"images of up to {max_pixels() / 1e6:g} megapixels are read, set {MAX_PIXELS_VARIABLE} to read larger ones"
