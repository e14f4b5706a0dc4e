"""The original images of a data set's samples, where they are available."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import Sample
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import FrameSource
from labelgen.media.image_file import read_image
from labelgen.media.open_frames import open_frames
from labelgen.media.sparse_frames import sparse_frames
from labelgen.shards import ShardDataset
from labelgen.shards.index import read_index

__all__ = ["Originals", "open_original"]


class Originals:
    """The original images of samples, at the places stated in `dataset.json`.

    Args:
        data: the shards.
    """

    def __init__(self, data: ShardDataset[Sample]) -> None:
        self._data = data
        self._places: dict[Path, dict[str, Any]] = {}
        for folder in {reader.path.parent for reader in data.readers}:
            try:
                entries = read_index(folder)["shards"]
            except LabelgenError:
                continue  # shards without an index have labels, but no originals
            self._places.update({folder / entry["name"]: entry.get("original", {}) for entry in entries})

    def place(self, index: int) -> dict[str, Any]:
        """Return where the original of a sample lies.

        Returns:
            `path`, `calibration`, `road_mask`, `masks`, `weights` and, if they were chosen, `stream` and
            `deinterlace` for a video; `images` for a folder of images; empty where unknown.
        """
        return self._places.get(self._data.locate(index)[0].path, {})

    def read(self, indices: Iterable[int]) -> dict[int, NDArray[np.uint8] | None]:
        """Return the original image (H, W, 3) BGR of each sample's window, or None. Each video is read once.

        Args:
            indices: numbers of the samples.
        """
        images: dict[int, NDArray[np.uint8] | None] = dict.fromkeys(indices)
        videos: dict[Path, dict[int, list[int]]] = {}
        places: dict[Path, dict[str, Any]] = {}
        for index in images:
            place, sample = self.place(index), self._data[index]
            if place.get("path"):
                places[Path(place["path"])] = place
                videos.setdefault(Path(place["path"]), {}).setdefault(sample.frame, []).append(index)
            elif place.get("images") and not _leads_out(sample.source):
                try:
                    images[index] = read_image(Path(place["images"]) / sample.source)
                except DataError:
                    continue  # the file was moved: the label is shown without its original
        for path, wanted in videos.items():
            if not path.is_file() and not path.is_dir():  # moved away, or a pipe that would be waited for
                continue
            choice = FrameChoice(wanted=wanted.__contains__, limit=max(wanted) + 1)
            with contextlib.suppress(DataError):  # damaged meanwhile
                for frame in sparse_frames(open_original(places[path]), choice):
                    for index in wanted[frame.number]:
                        images[index] = frame.image
        return images


def open_original(place: Mapping[str, Any]) -> FrameSource:
    """Open the video or folder of images at a place as it was read when labels were made.

    Raises:
        DataError: it cannot be read.
    """
    number = str(place.get("stream") or "")
    stream = int(number) if number.isdecimal() and len(number) < 6 else None
    return open_frames(Path(place["path"]), stream=stream, deinterlace=bool(place.get("deinterlace")))


def _leads_out(name: str) -> bool:
    path = Path(name)
    return path.is_absolute() or ".." in path.parts
