"""The BoxCars116k job: from crops with 3D boxes to shards of rectified crops with labels."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.choices import Pair
from labelgen.datasets.boxcars116k import BoxCars, Instance
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry.homography import apply_homography
from labelgen.geometry.rectification import Rectification
from labelgen.geometry.rectifying_homography import rectify_windows
from labelgen.jobs.runner import Job, Progress, finished_part
from labelgen.labeling.from_boxes import label_boxes
from labelgen.labels import Labels, Sample, Split
from labelgen.shards import Reject, ShardWriter
from labelgen.shards.image_codec import ImageCodec
from labelgen.shards.index import file_hash

__all__ = ["BoxCarsUnit", "boxcars_job"]

_SOURCE = "boxcars116k"
_CHUNK = 64
"""Crops whose geometry is computed at once."""
_MIN_SIDE_PX = 8
"""Least side of a crop, px: smaller ones show no vehicle."""


def boxcars_job(
    data: BoxCars,
    pair: Pair,
    size_wh: tuple[int, int],
    *,
    cameras: Sequence[str] | None = None,
    to_camera_only: bool = True,
    limit: int | None = None,
    per_shard: int = 1000,
    codec: ImageCodec | None = None,
) -> Job:
    """Plan the labels of a BoxCars116k tree.

    Args:
        data: the opened tree.
        pair: the vanishing points whose directions become axis-parallel.
        size_wh: size of the rectified crops, px.
        cameras: names of the cameras to use; None for all.
        to_camera_only: whether to leave out vehicles that drive away from the camera.
        limit: largest number of instances to label; None for all.
        per_shard: largest number of instances to label in a shard.
        codec: encoding of the images; JPEG of quality 95 by default.

    Raises:
        LabelgenError: an unknown camera.
    """
    all_cameras = sorted({*data.cameras, *data.bad_cameras})
    unknown = sorted(set(cameras or ()) - set(all_cameras))
    if unknown:
        raise LabelgenError(
            f"cameras {','.join(unknown)}: not in the data set; it has {', '.join(all_cameras)}", parameter="cameras"
        )
    codec = codec or ImageCodec()
    settings = {"kind": "boxcars", "rule": "3d-box", **codec.describe()}
    units: list[BoxCarsUnit] = []
    collected: list[tuple[Instance, str, Split]] = []
    eligible = total = 0

    def flush() -> None:
        nonlocal collected, eligible
        if collected:
            units.append(BoxCarsUnit(data, len(units), tuple(collected), pair, size_wh, settings, codec))
        collected, eligible = [], 0

    for instance in data.instances():
        if limit is not None and total >= limit:
            break
        if eligible == per_shard:
            flush()
        left_out = _left_out(instance, cameras, to_camera_only)
        collected.append((instance, left_out, data.split_of(instance.vehicle)))
        eligible += not left_out
        total += not left_out
    flush()
    if units:
        units[-1] = BoxCarsUnit(data, len(units) - 1, units[-1].instances, pair, size_wh, settings, codec, last=True)
    job_settings = {
        "pair": str(pair),
        "size": f"{size_wh[0]}x{size_wh[1]}",
        "cameras": None if cameras is None else sorted(cameras),
        "split": data.split_name,
        "to_camera_only": to_camera_only,
        "limit": limit,
        "per_shard": per_shard,
        **settings,
    }
    originals = {} if data.from_atlas else {_SOURCE: {"images": str(data.images.resolve())}}
    return Job("boxcars", job_settings, _inputs(data), units, originals)


def _inputs(data: BoxCars) -> dict[str, str]:
    """Return what identifies the files of a tree, by their names."""
    inputs = {
        "root": data.root.name,
        data.annotations.name: file_hash(data.annotations),
        "pictures": "atlas" if data.from_atlas else "images",
    }
    if data.splits is not None:
        inputs[data.splits.name] = file_hash(data.splits)
    if data.atlas is not None:
        inputs[data.atlas.name] = f"{data.atlas.stat().st_size} {file_hash(data.atlas)}"
    return inputs


def _left_out(instance: Instance, cameras: Sequence[str] | None, to_camera_only: bool) -> str:
    """Return why an instance is left out; "" where it is not."""
    if instance.problem:
        return "damaged entry"
    if cameras is not None and instance.camera not in cameras:
        return "camera left out"
    if to_camera_only and not instance.to_camera:
        return "drives away from the camera"
    return ""


@dataclass(frozen=True)
class BoxCarsUnit:
    """One shard of crops.

    Args:
        data: the tree; it holds the atlas in memory where there are no image files.
        number: number of the shard.
        instances: the instances, each with the reason why it is left out, or "", and its split.
        pair: the vanishing points whose directions become axis-parallel.
        size_wh: size of the rectified crops, px.
        settings: what decides the labels, for the shard.
        codec: encoding of the images.
        last: whether this is the last shard of the job.
    """

    data: BoxCars
    number: int
    instances: tuple[tuple[Instance, str, Split], ...]
    pair: Pair
    size_wh: tuple[int, int]
    settings: Mapping[str, Any]
    codec: ImageCodec
    last: bool = False

    @property
    def size(self) -> int:
        """Number of instances."""
        return len(self.instances)

    def _path(self, out: Path) -> Path:
        return out / f"shard-{self.number:05d}.h5"

    def shards(self, out: Path) -> list[Path] | None:
        """See `Unit`."""
        path = self._path(out)
        reader = finished_part(
            path,
            pair=str(self.pair),
            size=f"{self.size_wh[0]}x{self.size_wh[1]}",
            source=_SOURCE,
            part=self.number,
            last=int(self.last),
            settings=json.dumps(dict(self.settings), sort_keys=True),
        )
        return None if reader is None else [path]

    def run(self, out: Path, progress: Progress) -> None:
        """See `Unit`."""
        with ShardWriter(
            self._path(out), self.pair, self.size_wh, source=_SOURCE, part=self.number, settings=self.settings
        ) as writer:
            writer.last = self.last
            for start in range(0, len(self.instances), _CHUNK):
                chunk = self.instances[start : start + _CHUNK]
                self._label_chunk(chunk, writer)
                progress(len(chunk))

    def _label_chunk(self, chunk: Sequence[tuple[Instance, str, Split]], writer: ShardWriter) -> None:
        """Label a chunk. Samples and rejects keep the input's order.

        Images are read one by one; the geometry of all is computed at once, which is many times faster.
        """
        crops: list[tuple[Instance, Split, NDArray[np.uint8]]] = []
        for instance, left_out, split in chunk:
            if left_out:
                writer.reject(_reject(instance, left_out, instance.problem or f"camera {instance.camera}"))
            elif instance.camera not in self.data.cameras:
                reason = self.data.bad_cameras.get(instance.camera, f"camera {instance.camera} is not in the data set")
                writer.reject(_reject(instance, "no usable camera", reason))
            else:
                try:
                    image = self.data.read_crop(instance)
                except DataError as err:
                    writer.reject(_reject(instance, "unreadable picture", str(err)))
                    continue
                if min(image.shape[:2]) < _MIN_SIDE_PX:
                    detail = f"{image.shape[1]}x{image.shape[0]} px, less than {_MIN_SIDE_PX} on a side"
                    writer.reject(_reject(instance, "picture too small", detail))
                    continue
                crops.append((instance, split, image))
        if not crops:
            return
        offsets = np.array([instance.offset_px for instance, _, _ in crops])
        sizes = np.array([image.shape[1::-1] for _, _, image in crops])
        windows = np.concatenate([offsets, offsets + sizes], axis=1)
        vps = np.stack([self.data.vanishing_points[instance.camera] for instance, _, _ in crops])
        matrices, usable = rectify_windows(
            vps, windows[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2), self.pair, self.size_wh
        )
        vpus = apply_homography(matrices, vps[:, [self.pair.unused - 1]], behind="keep")[:, 0]
        labels = label_boxes(
            apply_homography(matrices, np.stack([instance.vertices_px for instance, _, _ in crops])), vpus, self.size_wh
        )
        for i, (instance, split, image) in enumerate(crops):
            label = labels[i]
            if not usable[i]:
                writer.reject(_reject(instance, "no rectification", f"the line joining {self.pair} crosses the crop"))
            elif not isinstance(label, Labels):
                writer.reject(_reject(instance, *label))
            else:
                rectification = Rectification(self.pair, self.size_wh, matrices[i], vpus[i])
                warped = rectification.warp_image(image, origin_px=(offsets[i, 0], offsets[i, 1]))
                writer.add(
                    Sample(
                        self.codec.encode(warped),
                        label,
                        rectification,
                        self.data.cameras[instance.camera],
                        instance.path,
                        instance.number,
                        split=split,
                        window_xyxy=windows[i],
                    )
                )


def _reject(instance: Instance, reason: str, detail: str) -> Reject:
    name = instance.path or f"vehicle {instance.vehicle}"
    return Reject(name, instance.number, -1, reason, detail)
