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

from labelgen.datasets.boxcars116k import BoxCars, Instance
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry.box_codec import decode_boxes, encode_boxes, reorder_vertices
from labelgen.geometry.homography import Array, apply_homography
from labelgen.geometry.rectification import Rectification, rectify_windows
from labelgen.geometry.vanishing_pair import Pair
from labelgen.jobs.runner import Job, Progress, finished_part
from labelgen.labels import Flag, Labels, Sample, Split, VehicleClass
from labelgen.shards import Reject, ShardWriter
from labelgen.shards.image_codec import ImageCodec

__all__ = ["BoxCarsUnit", "boxcars_job"]

_SOURCE = "boxcars116k"
_CHUNK = 64
# A decoded box further than this share of its size from the annotated one is flagged as misaligned.
_MISALIGNED = 0.02
# ... and beyond this one the label would show another box than the annotation: it is refused.
_UNUSABLE = 0.25
# c_c this close to 0 or 1 is a box without depth or without height: no vehicle.
_FLAT = 1e-3
# A crop with a side of fewer px shows no vehicle.
_SMALLEST = 8
# A label with less than this share of its box inside the picture is of something else than the picture shows.
_INSIDE = 0.5


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
        found = _label_boxes(
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


def _label_boxes(vertices: Array, vpus: Array, size_wh: tuple[int, int]) -> list[Labels | tuple[str, str]]:
    """For each rectified box (N, 8, 2) its label, or the reason and detail why there is none."""
    finite = np.asarray(np.isfinite(vertices).all(axis=(1, 2)))
    safe = np.where(finite[:, None, None], vertices, 0.0)
    encoded = encode_boxes(safe, vpus)
    # What is stored is float32: what cannot be decoded from that is no label.
    boxes = encoded.boxes_xyxy.astype(np.float32).astype(np.float64)
    cc = encoded.cc.astype(np.float32).astype(np.float64)
    decoded, valid = decode_boxes(boxes, cc, vpus)
    valid &= (cc > _FLAT) & (cc < 1 - _FLAT)
    decoded = reorder_vertices(decoded, encoded.mirrored, encoded.reversed)
    extent = np.maximum((boxes[:, 2:] - boxes[:, :2]).max(axis=1), 1e-9)
    with np.errstate(invalid="ignore"):
        off = np.asarray(np.abs(decoded - safe).max(axis=(1, 2)) / extent)
    outside = (boxes[:, :2] < -0.5).any(axis=1) | (boxes[:, 2:] > np.asarray(size_wh) + 0.5).any(axis=1)
    low, high = np.clip(boxes[:, :2], 0, size_wh), np.clip(boxes[:, 2:], 0, size_wh)
    area = np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1e-9)
    inside = (high - low).prod(axis=1) / area
    flags = (
        Flag.MIRRORED * encoded.mirrored
        + Flag.REVERSED * encoded.reversed
        + Flag.MISALIGNED * (off > _MISALIGNED)
        + Flag.TRUNCATED * outside
    )
    good = finite & valid & (off <= _UNUSABLE) & (inside >= _INSIDE)
    labels = Labels(boxes[good], cc[good], np.full(good.sum(), VehicleClass.VEHICLE), flags=flags[good])
    row = np.cumsum(good) - 1
    found: list[Labels | tuple[str, str]] = []
    for i in range(len(vertices)):
        if good[i]:
            found.append(labels[row[i] : row[i] + 1])
        elif not finite[i]:
            found.append(("box beyond the horizon", "a corner of its 3D box lies on or beyond the horizon"))
        elif not valid[i]:
            detail = f"c_c {cc[i]:.3f} in a box of {extent[i]:.1f} px decodes to no 3D box"
            found.append(("no valid 3D box", detail))
        elif inside[i] < _INSIDE:
            detail = f"{inside[i]:.0%} of its box lies in the picture; check 3DBB_offset and camera"
            found.append(("outside the picture", detail))
        else:
            detail = f"decoded, it lies {off[i]:.0%} of its size from the annotated one"
            found.append(("box against the vanishing points", detail))
    return found
