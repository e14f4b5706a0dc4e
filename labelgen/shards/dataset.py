"""The samples of several shards as one sequence, usable as a PyTorch data set."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import TEMPORARY_PREFIX
from labelgen.errors import DataError, LabelgenError
from labelgen.labels import Sample
from labelgen.shards.index import INDEX_NAME, read_index
from labelgen.shards.reader import ShardReader

__all__ = ["ShardDataset", "check_finished", "find_shards"]

_MAX_OPEN = 64
"""File handles a data set keeps open at once; some systems allow 256 to a process."""

Item = TypeVar("Item")


class ShardDataset(Generic[Item]):
    """The samples of several shards as one sequence.

    It is a map-style data set for `torch.utils.data.DataLoader`, and needs no torch itself. Files are opened at the
    first access, anew in each process, so that it can be pickled, forked and used by loader workers.

        >>> data = ShardDataset("shards/session0")                             # doctest: +SKIP
        >>> boxes, valid = data[0].vertices_px()                               # doctest: +SKIP
        >>> loader = DataLoader(data, batch_size=8, collate_fn=list, num_workers=2)  # doctest: +SKIP

    Args:
        paths: a shard or a folder of shards, or several of them.
        transform: function of a `Sample` whose result the data set gives in the sample's place, for instance a tuple
            of arrays. It must be picklable where loader workers are spawned.

    Attributes:
        readers: the shards, in order.

    Raises:
        DataError: no shard there, or a damaged one.
    """

    @overload
    def __init__(self: ShardDataset[Sample], paths: str | Path | Sequence[str | Path]) -> None: ...

    @overload
    def __init__(self, paths: str | Path | Sequence[str | Path], transform: Callable[[Sample], Item]) -> None: ...

    def __init__(
        self, paths: str | Path | Sequence[str | Path], transform: Callable[[Sample], Any] | None = None
    ) -> None:
        self.readers = [ShardReader(path) for path in find_shards(paths)]
        self._transform = transform
        lengths = []
        for reader in self.readers:
            lengths.append(len(reader))
            reader.close()
        self._starts = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
        self._recent: OrderedDict[int, None] = OrderedDict()

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> Item:
        """Return the sample of a number, transformed; negative numbers count from the end.

        Raises:
            IndexError: no such sample.
            DataError: its shard is damaged.
        """
        shard, row = self._locate(index)
        self._recent[shard] = None
        self._recent.move_to_end(shard)
        if len(self._recent) > _MAX_OPEN:
            oldest, _ = self._recent.popitem(last=False)
            self.readers[oldest].close()
        sample: Any = self.readers[shard][row]
        item: Item = sample if self._transform is None else self._transform(sample)
        return item

    def __iter__(self) -> Iterator[Item]:
        return (self[index] for index in range(len(self)))

    def locate(self, index: int) -> tuple[ShardReader, int]:
        """Return the shard that holds a sample, and the sample's number in it.

        Raises:
            IndexError: no such sample.
        """
        shard, row = self._locate(index)
        return self.readers[shard], row

    def _locate(self, index: int) -> tuple[int, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index %= len(self)
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        return shard, index - int(self._starts[shard])

    def table(self, name: str) -> NDArray[Any]:
        """Return a field of all shards, joined along its first axis.

        Args:
            name: name of the field in the format, for instance "labels/cc". Joined offsets are of no use: they start at
                0 in each shard.
        """
        return np.concatenate([reader.table(name) for reader in self.readers])


def check_finished(path: Path, readers: Sequence[ShardReader]) -> None:
    """Refuse a folder whose data set is not finished, or was not moved up whole. Files that are named are taken.

    Without an index, a folder counts as finished if no job is at work in it and the shards of each source are numbered
    without a gap up to the last one.

    Args:
        path: the folder, or a shard.
        readers: of its shards.

    Raises:
        DataError: it is not finished.
    """
    if not path.is_dir() or (path / INDEX_NAME).is_file():
        return
    parts: dict[str, set[int]] = {}
    whole = not any(path.glob(f"{TEMPORARY_PREFIX}*"))
    for reader in readers:
        parts.setdefault(str(reader.attributes["source"]), set()).add(int(reader.attributes["part"]))
        if reader.attributes["last"]:
            parts[str(reader.attributes["source"])].add(-1)
        reader.close()
    if not whole or any(numbers != set(range(-1, max(numbers) + 1)) for numbers in parts.values()):
        raise DataError(
            f"{path}: an unfinished data set, as it has no {INDEX_NAME}; run the command that made it once more, or "
            "name its shards as files"
        )


def find_shards(paths: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return the shard files of files and folders: folders in the order of their index, or by name without one.

    Args:
        paths: a shard or a folder of shards, or several of them.

    Raises:
        DataError: a path does not exist, or a folder holds no shards.
        LabelgenError: no path given.
    """
    shards: list[Path] = []
    for path in map(Path, [paths] if isinstance(paths, str | Path) else paths):
        if (path / INDEX_NAME).is_file():
            shards += [path / str(entry["name"]) for entry in read_index(path)["shards"]]
        elif path.is_dir():
            inside = sorted(path.glob("shard-*.h5"))
            if not inside:
                raise DataError(f"{path}: no shards in it (shard-*.h5); make some with labelgen boxcars or bcs-masks")
            shards += inside
        elif path.exists():
            shards.append(path)
        else:
            raise DataError(f"{path}: no such file or folder of shards")
    if not shards:
        raise LabelgenError("no shards named; give files or folders")
    return shards
