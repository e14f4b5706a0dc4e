"""Finding the original pictures behind the samples of a data set, where they are still at hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import LabelgenError
from labelgen.labels import Sample
from labelgen.shards.index import read_index
from labelgen.sources.frames import open_frames

__all__ = ["Originals"]


class Originals:
    """Original pictures of samples, from the places that dataset.json remembers.

    Args:
        folders: folders of shards.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self.sources: dict[str, dict[str, Any]] = {}
        for folder in folders:
            try:
                self.sources.update(read_index(folder).get("sources", {}))
            except LabelgenError:
                continue  # shards without an index: their labels are shown all the same

    def read(self, samples: Sequence[Sample]) -> list[NDArray[np.uint8] | None]:
        """The picture of each sample's window, or None. Videos are decoded once, in order."""
        found: list[NDArray[np.uint8] | None] = [None] * len(samples)
        videos: dict[str, dict[int, list[int]]] = {}
        for i, sample in enumerate(samples):
            if sample.source in self.sources:
                videos.setdefault(sample.source, {}).setdefault(sample.frame, []).append(i)
            elif (images := self.sources.get("images")) is not None:
                picture = cv2.imread(str(Path(images["path"]) / sample.source), cv2.IMREAD_COLOR)
                found[i] = None if picture is None else np.asarray(picture, dtype=np.uint8)
        for name, wanted in videos.items():
            path = Path(self.sources[name]["path"])
            if not path.exists():
                continue
            last = max(wanted)
            for frame in open_frames(path).frames(wanted.__contains__):
                for i in wanted[frame.number]:
                    found[i] = frame.image
                if frame.number >= last:
                    break
        return found
