"""The data that a manifest names: shards of a split, or seed files."""

from collections.abc import Iterable
from pathlib import Path

from levelproof.pipeline.store.layout import data_path
from levelproof.pipeline.store.remote import is_remote
from levelproof.pipeline.store.seed.file import file_of, is_seed
from levelproof.pipeline.store.seed.shard import SeedShard
from levelproof.pipeline.store.shard import Shard, stored_bytes


def open_shard(split: Path, name: str, size: str) -> Shard:
    """Open the shard or the seed file that a row of `split`'s manifest names, whose levels must have `size`.

    Raises:
        Failure: it is missing, damaged, of another size, or not in the split.
    """
    return SeedShard(file_of(split, name), size) if is_seed(split) else Shard(data_path(split, name), size)


def bytes_named(split: Path, names: Iterable[str]) -> int:
    """Sum the bytes of the shards or seed files that a manifest names."""
    if not is_seed(split):
        return sum(stored_bytes(data_path(split, name)) for name in names)
    return 0 if is_remote(split) else sum(file_of(split, name).stat().st_size for name in names)
