"""Writing one shard: samples are collected in memory and written as one file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import write_atomic
from labelgen.choices import Pair
from labelgen.geometry.camera import Camera
from labelgen.labels import IgnoredBoxes, Labels, Sample
from labelgen.shards.rejects import Reject, to_json_lines, writable
from labelgen.shards.schema import FIELDS, FORMAT, HASH_ATTRIBUTE, TEXT, VERSION, content_hash
from labelgen.version import __version__

__all__ = ["ShardWriter", "shard_bytes"]


class ShardWriter:
    """Context manager that writes one shard when its block ends without an exception.

    Args:
        path: the file; it appears when the shard is complete.
        pair: vanishing-point pair of all samples.
        size_wh: size of all images, px.
        source: name of the input that the samples come from.
        part: number of this shard among those of its source, from 0.
        settings: what decides the labels, as plain values; the same settings and input give the same bytes.

    Attributes:
        path: the file.
        last: whether this is the last shard of its source; to be set before the block ends.
        content_sha256: hash of the content, once written.

    Raises:
        OutputError: at the end of the block: the file cannot be written; nothing is left of it.
    """

    def __init__(
        self,
        path: str | Path,
        pair: Pair,
        size_wh: tuple[int, int],
        *,
        source: str = "",
        part: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        self.path = Path(path)
        self.last = False
        self.content_sha256 = ""
        self._attributes: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "producer": f"labelgen {__version__}",
            "pair": str(pair),
            "size": f"{size_wh[0]}x{size_wh[1]}",
            "source": writable(source),
            "part": part,
            "settings": json.dumps(dict(settings or {}), sort_keys=True),
        }
        self._samples: list[Sample] = []
        self._rejects: list[Reject] = []

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._finish()

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def part(self) -> int:
        """Number of this shard among those of its source, from 0."""
        return int(self._attributes["part"])

    @property
    def labels(self) -> int:
        """Number of labels added."""
        return sum(len(sample.labels) for sample in self._samples)

    @property
    def rejects(self) -> list[Reject]:
        """The rejects added."""
        return self._rejects

    def add(self, sample: Sample) -> None:
        """Append a sample.

        Raises:
            ValueError: its rectification is of another pair or size than the shard.
        """
        rectification = sample.rectification
        size = f"{rectification.size_wh[0]}x{rectification.size_wh[1]}"
        if (str(rectification.pair), size) != (self._attributes["pair"], self._attributes["size"]):
            raise ValueError(
                f"expected a sample of {self._attributes['pair']} {self._attributes['size']}, "
                f"got {rectification.pair} {size}"
            )
        self._samples.append(sample)

    def reject(self, reject: Reject) -> None:
        """Append an input without a label."""
        self._rejects.append(reject)

    def _finish(self) -> None:
        content, self.content_sha256 = shard_bytes({**self._attributes, "last": int(self.last)}, self._arrays())
        write_atomic(self.path, content)

    def _arrays(self) -> dict[str, NDArray[Any] | list[str]]:
        samples = self._samples
        labels = Labels.concatenate([sample.labels for sample in samples])
        ignored = IgnoredBoxes.concatenate([sample.ignored for sample in samples])
        cameras: dict[Camera, int] = {}
        camera_rows = [cameras.setdefault(sample.camera, len(cameras)) for sample in samples]
        sizes = [camera.image_wh or (0, 0) for camera in cameras]
        scales = [np.nan if camera.scale is None else camera.scale for camera in cameras]
        return {
            "images/bytes": np.frombuffer(b"".join(sample.encoded for sample in samples), dtype=np.uint8),
            "images/offset": _offsets([len(sample.encoded) for sample in samples]),
            "labels/box": labels.boxes_xyxy,
            "labels/cc": labels.cc,
            "labels/candidates": labels.candidates,
            "labels/class": labels.class_ids,
            "labels/score": labels.scores,
            "labels/flags": labels.flags,
            "labels/sigma": labels.sigmas,
            "labels/hidden": labels.hidden,
            "labels/offset": _offsets([len(sample.labels) for sample in samples]),
            "ignored/box": ignored.boxes_xyxy,
            "ignored/reason": ignored.reasons,
            "ignored/offset": _offsets([len(sample.ignored) for sample in samples]),
            "samples/matrix": np.array([s.rectification.matrix for s in samples]).reshape(-1, 3, 3),
            "samples/vpu": np.array([s.rectification.vpu for s in samples]).reshape(-1, 2),
            "samples/window": np.array([s.window_xyxy for s in samples], dtype=np.float64).reshape(-1, 4),
            "samples/camera": np.array(camera_rows, dtype=np.int32),
            "samples/source": [writable(sample.source) for sample in samples],
            "samples/frame": np.array([sample.frame for sample in samples], dtype=np.int64),
            "samples/time": np.array([sample.time_s for sample in samples], dtype=np.float64),
            "samples/split": np.array([int(sample.split) for sample in samples], dtype=np.uint8),
            "cameras/name": [writable(camera.name) for camera in cameras],
            "cameras/vp1": np.array([camera.vp1 for camera in cameras]).reshape(-1, 2),
            "cameras/vp2": np.array([camera.vp2 for camera in cameras]).reshape(-1, 2),
            "cameras/pp": np.array([camera.pp for camera in cameras]).reshape(-1, 2),
            "cameras/scale": np.array(scales, dtype=np.float64),
            "cameras/size": np.array(sizes, dtype=np.int32).reshape(-1, 2),
            "rejects": np.frombuffer(to_json_lines(self._rejects), dtype=np.uint8),
        }


def shard_bytes(attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any] | list[str]]) -> tuple[bytes, str]:
    """Return the bytes of a shard of the newest version, and the hash of its content.

    Args:
        attributes: values of `REQUIRED_ATTRIBUTES`; the version is set here.
        arrays: values of all fields.
    """
    attributes = {**attributes, "version": VERSION}
    attributes[HASH_ATTRIBUTE] = content_hash(attributes, arrays)
    # In memory first, so that a full disk gives a write error and no damaged HDF5 file.
    with h5py.File("shard", "w", driver="core", backing_store=False, libver=("earliest", "v110")) as file:
        for key, value in attributes.items():
            file.attrs[key] = value
        for name, spec in FIELDS.items():
            if spec.dtype == TEXT:
                file.create_dataset(name, data=arrays[name], dtype=h5py.string_dtype())
            else:
                file.create_dataset(name, data=arrays[name], dtype=spec.dtype)
        file.flush()
        return bytes(file.id.get_file_image()), str(attributes[HASH_ATTRIBUTE])


def _offsets(lengths: list[int]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64)
