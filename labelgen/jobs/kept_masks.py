"""Masks of a video that are kept beside its shards, as COCO JSON, so that other labels need no second run of a network.

While the video runs, each part has a file of lines, one for each frame, that is complete before the shard of the part
is. At the end they are joined, line by line, so that the memory does not grow with the video.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from labelgen.atomic_files import TEMPORARY_PREFIX, as_output_error
from labelgen.labels import VehicleClass
from labelgen.masks import InstanceMasks
from labelgen.media.frames import Frame

__all__ = ["KEPT_MASKS", "KEPT_PARTS", "KeptMasks", "kept_masks_name"]

KEPT_MASKS, KEPT_PARTS = "shard*.masks.json", "shard*.masks.jsonl"
"""Patterns of the files: of a whole video, and of one part while the job runs."""
_END = "frames"
"""Key of a part's last line, which says how many frames it has."""


def kept_masks_name(prefix: str) -> str:
    """Return the name of the file with the masks of the shards whose names begin so."""
    return f"{prefix}.masks.json"


class KeptMasks:
    """Context manager that writes the masks of one video.

    Args:
        folder: where the shards go.
        prefix: start of the shards' names.
        source: name of the video.

    Raises:
        OutputError: a file cannot be written; what was begun is removed.
    """

    def __init__(self, folder: Path, prefix: str, source: str) -> None:
        self._folder, self._prefix, self._source = folder, prefix, source
        self._part, self._count = -1, 0
        self._file: IO[str] | None = None

    def __enter__(self) -> KeptMasks:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
            self._temporary().unlink(missing_ok=True)

    def add(self, part: int, frame: Frame, masks: InstanceMasks) -> None:
        """Write the masks of one frame; parts come in order, each but the first completed by the next."""
        with as_output_error(self._path(part)):
            if part != self._part:
                self._complete_part()
                self._part, self._count = part, 0
                self._file = self._temporary().open("w", encoding="utf-8")
            assert self._file is not None
            self._file.write(json.dumps(_entry(frame, masks, self._source), separators=(",", ":")) + "\n")
            self._count += 1

    def finish(self) -> Path:
        """Join all parts and return the file."""
        path = self._folder / kept_masks_name(self._prefix)
        with as_output_error(path):
            self._complete_part()
            temporary = self._folder / f"{TEMPORARY_PREFIX}{path.name}.tmp"
            with temporary.open("w", encoding="utf-8") as file:
                categories = [{"id": member.value + 1, "name": member.name.lower()} for member in VehicleClass]
                file.write(f'{{"categories":{json.dumps(categories)},"images":[')
                _write_items(file, (entry["image"] for entry in self._entries()))
                file.write('],"annotations":[')
                _write_items(
                    file,
                    (
                        {"image_id": number, **annotation}
                        for number, entry in enumerate(self._entries(), start=1)
                        for annotation in entry["annotations"]
                    ),
                )
                file.write("]}\n")
            os.replace(temporary, path)
        return path

    def complete_parts(self) -> int:
        """Return how many of the first parts are whole on disk: a damaged one must be made again."""
        count = 0
        while _is_whole(self._path(count)):
            count += 1
        return count

    def _entries(self) -> Iterator[dict[str, Any]]:
        for path in sorted(self._folder.glob(f"{self._prefix}-?????.masks.jsonl")):
            with path.open(encoding="utf-8") as file:
                for line in file:
                    entry = json.loads(line)
                    if _END not in entry:
                        yield entry

    def _complete_part(self) -> None:
        if self._file is not None:
            self._file.write(json.dumps({_END: self._count}) + "\n")
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None
            os.replace(self._temporary(), self._path(self._part))

    def _path(self, part: int) -> Path:
        return self._folder / f"{self._prefix}-{part:05d}.masks.jsonl"

    def _temporary(self) -> Path:
        return self._folder / f"{TEMPORARY_PREFIX}{self._prefix}.masks.tmp"


def _is_whole(path: Path) -> bool:
    """Return whether a part's file ends as it should, and holds as many frames as its end says."""
    try:
        with path.open(encoding="utf-8") as file:
            entries = [json.loads(line) for line in file]
        *frames, end = entries
        return end == {_END: len(frames)} and all(isinstance(f, dict) and "image" in f for f in frames)
    except (OSError, ValueError, RecursionError):
        return False


def _write_items(file: IO[str], items: Iterator[dict[str, Any]]) -> None:
    for number, item in enumerate(items, start=1):
        file.write((",\n" if number > 1 else "\n") + json.dumps({"id": number, **item}, separators=(",", ":")))


def _entry(frame: Frame, masks: InstanceMasks, source: str) -> dict[str, Any]:
    """Return an image entry and its annotations, without their ids."""
    width, height = masks.frame_wh
    image = {
        "file_name": frame.name or f"{source}/{frame.number:06d}.jpg",
        "frame": frame.number,
        "width": width,
        "height": height,
    }
    annotations = []
    for crop, origin, class_id, score in zip(
        masks.crops, masks.origins.tolist(), masks.class_ids.tolist(), masks.scores.tolist(), strict=True
    ):
        annotations.append(
            {
                "category_id": class_id + 1,
                "segmentation": _run_lengths(crop, (origin[0], origin[1]), (width, height)),
                "area": int(np.count_nonzero(crop)),
                "bbox": [*origin, crop.shape[1], crop.shape[0]],
                "iscrowd": 0,
                # A score says that a network made the mask.
                **({"score": round(score, 4)} if masks.are_predicted else {}),
            }
        )
    return {"image": image, "annotations": annotations}


def _run_lengths(crop: NDArray[np.bool_], origin: tuple[int, int], frame_wh: tuple[int, int]) -> dict[str, Any]:
    """Return COCO's compressed RLE of a mask, from its crop alone."""
    width, height = frame_wh
    (x, y), (rows, columns) = origin, crop.shape
    # Pixels are counted down the columns, from the crop's first column on.
    flat = np.zeros((columns, height), dtype=np.bool_)
    flat[:, y : y + rows] = crop.T
    changes = np.flatnonzero(np.diff(flat.ravel(), prepend=False, append=False)) + x * height
    counts = np.diff(changes, prepend=0, append=width * height)
    counts = counts[: len(counts) - int(counts[-1] == 0)]
    rle = coco_mask.frPyObjects({"size": [height, width], "counts": counts.tolist()}, height, width)
    return {"size": [height, width], "counts": rle["counts"].decode("ascii")}
