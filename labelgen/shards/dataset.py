"""Several shards read as one sequence of samples."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError, LabelgenError
from labelgen.labels import Sample
from labelgen.shards.index import INDEX_NAME, read_index
from labelgen.shards.reader import ShardReader

__all__ = ["ShardSet", "find_shards"]

# File handles a set keeps open at once; systems allow 256 to a process, or more.
_MOST_OPEN = 64


class ShardSet:
    """Several shards read as one sequence of samples. Picklable, like its readers.

    Args:
        paths: shards, or folders of shards.

    Raises:
        DataError: none found.
    """

    def __init__(self, paths: Sequence[str | Path]) -> None:
        self.readers = [ShardReader(path) for path in find_shards(paths)]
        lengths = []
        for reader in self.readers:
            lengths.append(len(reader))
            reader.close()
        self._starts = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        self._recent: OrderedDict[int, None] = OrderedDict()

    def __len__(self) -> int:
        return int(self._starts[-1])

    def locate(self, index: int) -> tuple[ShardReader, int]:
        """Reader and number within it of a sample."""
        shard, row = self._locate(index)
        return self.readers[shard], row

    def _locate(self, index: int) -> tuple[int, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index %= len(self)
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        return shard, index - int(self._starts[shard])

    def __getitem__(self, index: int) -> Sample:
        shard, row = self._locate(index)
        self._recent[shard] = None
        self._recent.move_to_end(shard)
        if len(self._recent) > _MOST_OPEN:
            oldest, _ = self._recent.popitem(last=False)
            self.readers[oldest].close()
        return self.readers[shard][row]

    def table(self, name: str) -> NDArray[Any]:
        """A field of all shards, one after the other; offsets excepted, which start anew in each."""
        return np.concatenate([reader.table(name) for reader in self.readers])


def find_shards(paths: Sequence[str | Path]) -> list[Path]:
    """Shard files named by files and folders, in a fixed order; DataError where there are none."""
    found: list[Path] = []
    for path in map(Path, paths):
        if (path / INDEX_NAME).is_file():
            found += [path / str(entry["name"]) for entry in read_index(path)["shards"]]
        elif path.is_dir():
            inside = sorted(path.glob("shard-*.h5"))
            if not inside:
                raise DataError(f"{path}: no shards in it (shard-*.h5); make some with labelgen boxcars or bcs-masks")
            found += inside
        elif path.exists():
            found.append(path)
        else:
            raise DataError(f"{path}: no such file or folder of shards")
    if not found:
        raise LabelgenError("no shards named; give files or folders")
    return found
