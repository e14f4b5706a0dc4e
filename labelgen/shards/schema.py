"""The shard format, version 1, field by field.

    shard-00000.h5      attributes: format, version, producer, pair, size, source, part, last, settings (JSON),
                        content_sha256
      images/bytes      uint8 (total,)     JPEG or PNG bytes, back to back     images/offset  int64 (N + 1,)
      labels/box        float32 (L, 4)     x0, y0, x1, y1, rectified px        labels/offset  int64 (N + 1,)
      labels/cc         float32 (L,)       labels/candidates  float32 (L, 2)   c_c, and both candidates of masks
      labels/class      uint8 (L,)         labels/score       float32 (L,)     labels/flags   uint16 (L,)
      samples/matrix    float64 (N, 3, 3)  frame px -> rectified px            samples/vpu    float64 (N, 2)
      samples/window    float64 (N, 4)     the part of the frame the source shows, frame px
      samples/camera    int32 (N,)         row of cameras/                     samples/split  uint8 (N,)
      samples/source    UTF-8 (N,)         samples/frame  int64 (N,)           samples/time   float64 (N,) seconds
      cameras/name      UTF-8 (C,)         cameras/vp1, vp2, pp  float64 (C, 2)
      cameras/scale     float64 (C,)       NaN: unknown                        cameras/size   int32 (C, 2), 0: unknown
      rejects           uint8 (bytes,)     JSON lines: every input of this shard that gave no label, and why

Images and labels of all samples are joined into few large arrays, so that a sample is one slice of each.

Convention:
    Boxes are x0, y0, x1, y1 in rectified px, pixels being areas; homographies act on column vectors (x, y, 1).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "FIELDS",
    "FORMAT",
    "HASH_ATTRIBUTE",
    "IMAGES",
    "REQUIRED_ATTRIBUTES",
    "TEXT",
    "VERSION",
    "FieldSpec",
    "content_hash",
]

FORMAT = "labelgen-shard"
VERSION = 1
HASH_ATTRIBUTE = "content_sha256"
REQUIRED_ATTRIBUTES = ("format", "version", "producer", "pair", "size", "source", "part", "last", "settings")
TEXT = "text"
IMAGES = "images/bytes"


@dataclass(frozen=True)
class FieldSpec:
    """One HDF5 data set: its type, its number of rows, and the shape of a row.

    Args:
        dtype: NumPy type string, or `TEXT`.
        rows: "N" samples, "N+1" offsets, "L" labels, "C" cameras, "*" anything.
        shape: of one row.
    """

    dtype: str
    rows: str
    shape: tuple[int, ...] = ()


FIELDS: Mapping[str, FieldSpec] = {
    "images/bytes": FieldSpec("|u1", "*"),
    "images/offset": FieldSpec("<i8", "N+1"),
    "labels/box": FieldSpec("<f4", "L", (4,)),
    "labels/cc": FieldSpec("<f4", "L"),
    "labels/candidates": FieldSpec("<f4", "L", (2,)),
    "labels/class": FieldSpec("|u1", "L"),
    "labels/score": FieldSpec("<f4", "L"),
    "labels/flags": FieldSpec("<u2", "L"),
    "labels/offset": FieldSpec("<i8", "N+1"),
    "samples/matrix": FieldSpec("<f8", "N", (3, 3)),
    "samples/vpu": FieldSpec("<f8", "N", (2,)),
    "samples/window": FieldSpec("<f8", "N", (4,)),
    "samples/camera": FieldSpec("<i4", "N"),
    "samples/source": FieldSpec(TEXT, "N"),
    "samples/frame": FieldSpec("<i8", "N"),
    "samples/time": FieldSpec("<f8", "N"),
    "samples/split": FieldSpec("|u1", "N"),
    "cameras/name": FieldSpec(TEXT, "C"),
    "cameras/vp1": FieldSpec("<f8", "C", (2,)),
    "cameras/vp2": FieldSpec("<f8", "C", (2,)),
    "cameras/pp": FieldSpec("<f8", "C", (2,)),
    "cameras/scale": FieldSpec("<f8", "C"),
    "cameras/size": FieldSpec("<i4", "C", (2,)),
    "rejects": FieldSpec("|u1", "*"),
}


def content_hash(attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any] | list[str]]) -> str:
    """Return the SHA-256 of a shard's content, which depends neither on HDF5's layout nor on the producer's version.

    Args:
        attributes: values of `REQUIRED_ATTRIBUTES`.
        arrays: values of `FIELDS`.
    """
    digest = hashlib.sha256()
    for key in REQUIRED_ATTRIBUTES:
        if key != "producer":
            digest.update(f"@{key}={attributes[key]}\n".encode())
    for name, spec in FIELDS.items():
        values = arrays[name]
        if spec.dtype == TEXT:
            texts = [str(value).encode() for value in values]
            digest.update(f"#{name} {len(texts)}\n".encode())
            for text in texts:
                digest.update(b"%d:" % len(text))
                digest.update(text)
        else:
            array = np.ascontiguousarray(values, dtype=spec.dtype)
            digest.update(f"#{name} {array.shape}\n".encode())
            digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
