"""The boxcars job: crops with 3D boxes -> rectified crops with labels."""

from __future__ import annotations

import hashlib
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

__all__ = ["BoxCarsUnit", "boxcars_job"]

_SOURCE = "boxcars116k"
_CHUNK = 64
# A crop with a side of fewer px shows no vehicle.
_SMALLEST = 8


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
        pair, size_wh: the rectification.
        cameras: names of the cameras to use; None for all.
        to_camera_only: leave out vehicles that drive away.
        limit: stop after so many instances that are not left out.
        per_shard: images in a shard.
        codec: how images are stored.

    Raises:
        LabelgenError: an unknown camera.
    """
    known = sorted({*data.cameras, *data.bad_cameras})
    unknown = sorted(set(cameras or ()) - set(known))
    if unknown:
        raise LabelgenError(f"--cameras {','.join(unknown)}: not in the data set; it has {', '.join(known)}")
    codec = codec or ImageCodec()
    settings = {"kind": "boxcars", "rule": "3d-box", **codec.describe()}
    units: list[BoxCarsUnit] = []
    taken: list[tuple[Instance, str, Split]] = []
    eligible = total = 0

    def flush() -> None:
        nonlocal taken, eligible
        if taken:
            units.append(BoxCarsUnit(data, len(units), tuple(taken), pair, size_wh, settings, codec))
        taken, eligible = [], 0

    for instance in data.instances():
        if limit is not None and total >= limit:
            break
        if eligible == per_shard:
            flush()
        left_out = _left_out(instance, cameras, to_camera_only)
        taken.append((instance, left_out, data.split_of(instance.vehicle)))
        eligible += not left_out
        total += not left_out
    flush()
    if units:
        units[-1] = BoxCarsUnit(data, len(units) - 1, units[-1].instances, pair, size_wh, settings, codec, last=True)
    chosen = {
        "pair": str(pair),
        "size": f"{size_wh[0]}x{size_wh[1]}",
        "cameras": None if cameras is None else sorted(cameras),
        "split": data.split_name,
        "to_camera_only": to_camera_only,
        "limit": limit,
        "per_shard": per_shard,
        **settings,
    }
    inputs = {
        "root": data.root.name,
        data.annotations.name: _digest(data.annotations),
        "pictures": "atlas" if data.from_atlas else "images",
    }
    if data.splits is not None:
        inputs[data.splits.name] = _digest(data.splits)
    if data.atlas is not None:
        inputs[data.atlas.name] = f"{data.atlas.stat().st_size} {_digest(data.atlas)}"
    originals = {} if data.from_atlas else {_SOURCE: {"images": str(data.images.resolve())}}
    return Job("boxcars", chosen, inputs, units, originals)


def _digest(path: Path) -> str:
    # Of the whole file: the atlas too was read whole to open the tree, and its ends alone do not show a change.
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _left_out(instance: Instance, cameras: Sequence[str] | None, to_camera_only: bool) -> str:
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
        number: of the shard.
        instances: each with the reason why it is left out, or "", and its split.
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
        """Instances to look at."""
        return len(self.instances)

    def _path(self, out: Path) -> Path:
        return out / f"shard-{self.number:05d}.h5"

    def shards(self, out: Path) -> list[Path] | None:
        """See `Unit`."""
        path = self._path(out)
        found = finished_part(
            path,
            pair=str(self.pair),
            size=f"{self.size_wh[0]}x{self.size_wh[1]}",
            source=_SOURCE,
            part=self.number,
            last=int(self.last),
            settings=json.dumps(dict(self.settings), sort_keys=True),
        )
        return None if found is None else [path]

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
        """Label a chunk: pictures one by one, geometry all at once. Samples and rejects keep the input's order."""
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
                if min(image.shape[:2]) < _SMALLEST:
                    detail = f"{image.shape[1]}x{image.shape[0]} px, less than {_SMALLEST} on a side"
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
        found = label_boxes(
            apply_homography(matrices, np.stack([instance.vertices_px for instance, _, _ in crops])), vpus, self.size_wh
        )
        for i, (instance, split, image) in enumerate(crops):
            label = found[i]
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
