"""Why a file is no video that can be read, in words."""

from __future__ import annotations

from pathlib import Path

__all__ = ["why_unreadable"]

_UNKNOWN = "not a video file, or one damaged at its beginning"
_BOX_TYPES = {b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"uuid", b"moof", b"pnot", b"sidx", b"styp"}


def why_unreadable(path: Path) -> str:
    """Return why FFmpeg does not take a file; for MP4 and MOV, whether the end with its index is missing.

    Args:
        path: of the file, which exists.
    """
    # The file is a sequence of boxes: size in 4 bytes, type in 4, or size 1 and the size in the next 8. `moov` is the
    # index, which cameras write last.
    size = path.stat().st_size
    place, types = 0, []
    with path.open("rb") as file:
        while place + 8 <= size:
            file.seek(place)
            head = file.read(16)
            kind, length = head[4:8], int.from_bytes(head[:4])
            if kind not in _BOX_TYPES:
                break
            types.append(kind)
            if length == 1:
                length = int.from_bytes(head[8:16])
            elif length == 0:
                length = size - place
            place += max(8, length)
    if not types:
        return _UNKNOWN
    if b"moov" not in types:
        return (
            "its end is missing, and with it the index without which no frame is found; copy the file again, or have "
            "the camera finish the recording"
        )
    if types[-1] == b"moov" and place > size:
        return "it is cut off within its index, without which no frame is found; copy the file again"
    return _UNKNOWN
