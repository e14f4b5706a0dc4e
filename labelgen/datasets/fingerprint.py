"""The identity of an input by its content, without reading all of it: videos are large."""

from __future__ import annotations

import hashlib
from pathlib import Path

from labelgen.errors import DataError
from labelgen.media.image_folder import ImageFolder

__all__ = ["fingerprint"]

_END_BYTES = 1 << 20


def fingerprint(path: Path) -> str:
    """Return the identity of a file or folder of images.

    Args:
        path: of the input.

    Returns:
        name, size and the hash of the first and last MiB; of a folder its name, and the hash of the names and sizes
        of its images.

    Raises:
        DataError: it cannot be read.
    """
    try:
        if path.is_dir():
            names = [f"{name}:{(path / name).stat().st_size}" for name in ImageFolder(path).file_names]
            listed = "\n".join(names).encode("utf-8", "surrogateescape")
            return f"{path.name} {hashlib.sha256(listed).hexdigest()[:16]}"
        size = path.stat().st_size
        with path.open("rb") as file:
            digest = hashlib.sha256(file.read(_END_BYTES))
            file.seek(max(0, size - _END_BYTES))
            digest.update(file.read(_END_BYTES))
    except OSError as err:
        raise DataError(f"{path}: {err.strerror or err}") from None
    return f"{path.name} {size} {digest.hexdigest()[:16]}"
