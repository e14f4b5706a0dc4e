"""The HDF5 shard format: schema, writer, reader, index, validation and merging. The only room that knows h5py."""

from labelgen.shards.dataset import ShardSet, find_shards
from labelgen.shards.index import DatasetSummary, read_index, summarise, write_index
from labelgen.shards.merge import merge_shards
from labelgen.shards.reader import ShardReader
from labelgen.shards.rejects import Reject
from labelgen.shards.validate import validate_shard, validate_shards
from labelgen.shards.writer import ShardWriter

__all__ = [
    "DatasetSummary",
    "Reject",
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
