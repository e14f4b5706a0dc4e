"""The size of an encoded image, read from its header: what it would take to decode it is known before.

Sources: the headers of PNG (W3C), JPEG (ITU T.81, B.2), BMP, GIF89a, TIFF 6.0 and BigTIFF, WebP (RFC 9649), Netpbm.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

__all__ = ["image_size"]

_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_JPEG_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def image_size(encoded: memoryview) -> tuple[int, int] | None:
    """Return width and height px as an image's header states them; None where it is of no known format.

    Args:
        encoded: bytes of an image file.
    """
    start = bytes(encoded[:16])
    for pattern, read in _READERS:
        if re.match(pattern, start, re.DOTALL):
            try:
                return read(encoded)
            except (struct.error, IndexError, ValueError):
                return None
    return None


def _unpack(encoded: memoryview, form: str, at: int) -> tuple[int, ...]:
    return struct.unpack_from(form, encoded, at)


def _png(encoded: memoryview) -> tuple[int, int]:
    width, height = _unpack(encoded, ">II", 16)
    return width, height


def _jpeg(encoded: memoryview) -> tuple[int, int]:
    at = 2
    while True:
        while encoded[at] != 0xFF:  # decoders skip what is no marker
            at += 1
        while encoded[at] == 0xFF:
            at += 1
        marker, at = encoded[at], at + 1
        if marker in _JPEG_FRAMES:
            height, width = _unpack(encoded, ">HH", at + 3)
            return width, height
        if marker == 0xDA:
            raise ValueError("image data before a frame header")
        if marker not in _JPEG_WITHOUT_LENGTH and marker:
            at += _unpack(encoded, ">H", at)[0]


def _bmp(encoded: memoryview) -> tuple[int, int]:
    (header,) = _unpack(encoded, "<I", 14)
    width, height = _unpack(encoded, "<HH" if header == 12 else "<ii", 18)
    return abs(width), abs(height)


def _gif(encoded: memoryview) -> tuple[int, int]:
    width, height = _unpack(encoded, "<HH", 6)
    return width, height


def _webp(encoded: memoryview) -> tuple[int, int]:
    kind = bytes(encoded[12:16])
    if kind == b"VP8 ":
        width, height = _unpack(encoded, "<HH", 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = _unpack(encoded, "<I", 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        width, height = (int.from_bytes(encoded[at : at + 3], "little") + 1 for at in (24, 27))
        return width, height
    raise ValueError("no image in it")


def _tiff(encoded: memoryview) -> tuple[int, int]:
    order = "<" if encoded[0] == ord("I") else ">"
    big = _unpack(encoded, order + "H", 2)[0] == 43
    (at,) = _unpack(encoded, order + ("Q" if big else "I"), 8 if big else 4)
    (count,) = _unpack(encoded, order + ("Q" if big else "H"), at)
    at += 8 if big else 2
    sizes = {}
    for entry in range(min(count, 4096)):
        place = at + entry * (20 if big else 12)
        tag, kind = _unpack(encoded, order + "HH", place)
        if tag in (256, 257) and kind in _TIFF_TYPES:
            (sizes[tag],) = _unpack(encoded, order + _TIFF_TYPES[kind], place + (12 if big else 8))
    if len(sizes) < 2:
        raise ValueError("no size in it")
    return sizes[256], sizes[257]


def _pnm(encoded: memoryview) -> tuple[int, int]:
    text = re.sub(rb"#[^\n]*", b"", bytes(encoded[2:4096]))
    if encoded[1] == ord("7"):
        named = dict(re.findall(rb"(WIDTH|HEIGHT)\s+(\d{1,18})\s", text))
        return int(named.get(b"WIDTH", b"")), int(named.get(b"HEIGHT", b""))
    numbers = re.match(rb"\s*(\d{1,18})\s+(\d{1,18})\s", text)
    if numbers is None:
        raise ValueError("no size in it")
    return int(numbers[1]), int(numbers[2])


_READERS: tuple[tuple[bytes, Callable[[memoryview], tuple[int, int]]], ...] = (
    (rb"\x89PNG\r\n\x1a\n", _png),
    (rb"\xff\xd8\xff", _jpeg),
    (rb"BM", _bmp),
    (rb"GIF8[79]a", _gif),
    (rb"RIFF....WEBP", _webp),
    (rb"(II|MM)(\*\0|\0\*|\+\0|\0\+)", _tiff),
    (rb"P[1-7]\s", _pnm),
)
