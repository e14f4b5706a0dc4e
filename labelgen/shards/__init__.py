"""Shards, the HDF5 files of labelled images: write, read, index, validate and merge them."""

from labelgen.shards.dataset import ShardDataset, find_shards
from labelgen.shards.index import DatasetSummary, read_index, summarise, write_index
from labelgen.shards.merge import merge_shards
from labelgen.shards.reader import ShardReader
from labelgen.shards.rejects import Reject
from labelgen.shards.validate import validate_shard, validate_shards
from labelgen.shards.writer import ShardWriter

__all__ = [
    "DatasetSummary",
    "Reject",
    "ShardDataset",
    "ShardReader",
    "ShardSet",
    "ShardWriter",
    "find_shards",
    "merge_shards",
    "read_index",
    "summarise",
    "validate_shard",
    "validate_shards",
    "write_index",
]

ShardSet = ShardDataset
"""Alias of `ShardDataset`, for scripts that read shards under this name."""
