"""The data that a manifest names: shards of a split, or seed files."""

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from levelproof.pipeline.store.layout import data_path
from levelproof.pipeline.store.remote import stored_at
from levelproof.pipeline.store.seed.file import file_of, is_seed, written
from levelproof.pipeline.store.seed.shard import SeedShard
from levelproof.pipeline.store.shard import Shard, stored_bytes
from levelproof.pipeline.urls import is_remote


def open_shard(split: Path, name: str, size: str) -> Shard:
    """Open the shard or the seed file that a row of `split`'s manifest names, whose levels must have `size`.

    Raises:
        Failure: it is missing, damaged, of another size, or not in the split.
    """
    if not is_seed(split):
        return Shard(data_path(split, name), size)
    file = file_of(split, name)
    return _seed_shard(file, size, stored_at(file) if is_remote(file) else written(file))


def bytes_named(split: Path, names: Iterable[str]) -> int:
    """Sum the bytes of the shards or seed files that a manifest names."""
    if not is_seed(split):
        return sum(stored_bytes(data_path(split, name)) for name in names)
    return sum(map(_bytes_of, {file_of(split, name) for name in names}))


@lru_cache(maxsize=2)
def _seed_shard(file: Path, size: str, _: tuple | None) -> SeedShard:
    """Open a seed file once until it is `written` again: exports read its rows a block at a time."""
    return SeedShard(file, size)


def _bytes_of(file: Path) -> int:
    return stored_at(file).size if is_remote(file) else file.stat().st_size
