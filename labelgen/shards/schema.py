"""The shard format, version 2, field by field.

    shard-00000.h5      attributes: format, version, producer, pair, size, source, part, last, settings (JSON),
                        content_sha256
      images/bytes      uint8 (total,)     JPEG or PNG bytes, back to back     images/offset  int64 (N + 1,)
      labels/box        float32 (L, 4)     x0, y0, x1, y1, rectified px        labels/offset  int64 (N + 1,)
      labels/cc         float32 (L,)       labels/candidates  float32 (L, 2)   c_c, and both candidates of masks
      labels/class      uint8 (L,)         labels/score       float32 (L,)     labels/flags   uint16 (L,)
      labels/sigma      float32 (L, 5)     standard deviations of the box, px, and of c_c; NaN: unknown (version 2)
      labels/hidden     float32 (L,)       share of the vehicle that something hides; NaN: unknown (version 2)
      ignored/box       float32 (K, 4)     vehicles without a label            ignored/offset  int64 (N + 1,), both (2)
      ignored/reason    uint8 (K,)         why they have none (version 2)
      samples/matrix    float64 (N, 3, 3)  frame px -> rectified px            samples/vpu    float64 (N, 2)
      samples/window    float64 (N, 4)     the part of the frame the source shows, frame px
      samples/camera    int32 (N,)         row of cameras/                     samples/split  uint8 (N,)
      samples/source    UTF-8 (N,)         samples/frame  int64 (N,)           samples/time   float64 (N,) seconds
      cameras/name      UTF-8 (C,)         cameras/vp1, vp2, pp  float64 (C, 2)
      cameras/scale     float64 (C,)       NaN: unknown                        cameras/size   int32 (C, 2), 0: unknown
      rejects           uint8 (bytes,)     JSON lines: every input of this shard that gave no label, and why

Version 1 lacks the fields that are marked; such files are read as if they held nothing there (`complete_fields`).
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
    "READABLE_VERSIONS",
    "REQUIRED_ATTRIBUTES",
    "TEXT",
    "VERSION",
    "FieldSpec",
    "complete_fields",
    "content_hash",
    "fields_of",
]

FORMAT = "labelgen-shard"
VERSION = 2
READABLE_VERSIONS = (1, 2)
HASH_ATTRIBUTE = "content_sha256"
REQUIRED_ATTRIBUTES = ("format", "version", "producer", "pair", "size", "source", "part", "last", "settings")
TEXT = "text"
IMAGES = "images/bytes"


@dataclass(frozen=True)
class FieldSpec:
    """One HDF5 data set: its type, its number of rows, and the shape of a row.

    Args:
        dtype: NumPy type string, or `TEXT`.
        rows: "N" samples, "N+1" offsets, "L" labels, "K" ignored boxes, "C" cameras, "*" anything.
        shape: of one row.
        since: first version of the format that has the field.
    """

    dtype: str
    rows: str
    shape: tuple[int, ...] = ()
    since: int = 1


FIELDS: Mapping[str, FieldSpec] = {
    "images/bytes": FieldSpec("|u1", "*"),
    "images/offset": FieldSpec("<i8", "N+1"),
    "labels/box": FieldSpec("<f4", "L", (4,)),
    "labels/cc": FieldSpec("<f4", "L"),
    "labels/candidates": FieldSpec("<f4", "L", (2,)),
    "labels/class": FieldSpec("|u1", "L"),
    "labels/score": FieldSpec("<f4", "L"),
    "labels/flags": FieldSpec("<u2", "L"),
    "labels/sigma": FieldSpec("<f4", "L", (5,), since=2),
    "labels/hidden": FieldSpec("<f4", "L", since=2),
    "labels/offset": FieldSpec("<i8", "N+1"),
    "ignored/box": FieldSpec("<f4", "K", (4,), since=2),
    "ignored/reason": FieldSpec("|u1", "K", since=2),
    "ignored/offset": FieldSpec("<i8", "N+1", since=2),
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


def fields_of(version: int) -> dict[str, FieldSpec]:
    """Return the fields that files of a version of the format have."""
    return {name: spec for name, spec in FIELDS.items() if spec.since <= version}


def complete_fields(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return fields of a file of any version with those of the newest one: nothing is ignored, numbers are unknown.

    Args:
        arrays: values of all fields of the file's version, "images/bytes" may lack.
    """
    rows = {"L": len(arrays["labels/cc"]), "K": 0, "N+1": len(arrays["labels/offset"])}
    missing = {name: spec for name, spec in FIELDS.items() if spec.since > 1 and name not in arrays}
    neutral = {
        name: np.full((rows[spec.rows], *spec.shape), np.nan if "f" in spec.dtype else 0, dtype=spec.dtype)
        for name, spec in missing.items()
    }
    return {**arrays, **neutral}


def content_hash(attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any] | list[str]]) -> str:
    """Return the SHA-256 of a shard's content, which depends neither on HDF5's layout nor on the producer's version.

    Args:
        attributes: values of `REQUIRED_ATTRIBUTES`.
        arrays: values of the fields of its version.
    """
    digest = hashlib.sha256()
    for key in REQUIRED_ATTRIBUTES:
        if key != "producer":
            digest.update(f"@{key}={attributes[key]}\n".encode())
    for name, spec in fields_of(int(attributes["version"])).items():
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
