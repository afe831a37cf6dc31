"""A work unit's solved levels as one zarr v3 group of packed arrays, as docs/storage.md shows them.

One trajectory is one chunk: larger chunks save under 1% and cost random reads a factor of 3.
"""

import json
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from levelgen.level import name_of
from physics.types import Size
from pipeline.errors import Failure
from pipeline.store.chunks import Chunks, ordinary_file
from pipeline.store.contents import ContentsError, check_level_ids, check_numbers, size_in, table_for
from pipeline.store.disk import flush
from pipeline.store.layout import data_path, fragment_of
from pipeline.store.packing import empty, pack, unpack
from pipeline.store.schema import SHARD_VERSION, FieldSpec, field_table

FORMAT = "levelproof.shard"
# What reading bytes that nobody vouches for can raise
DAMAGE = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, MemoryError, OverflowError)
LEVEL = 5  # of zstd; 9 saves 2% and encodes at 3 MB/s


def write_shard(path: Path, level_ids: Sequence[int], arrays: Mapping[str, np.ndarray]) -> None:
    """Write `arrays` (level axis last, see `pipeline.store.schema`) to a new group at `path`, durably.

    Raises:
        FileExistsError: `path` is there already.
        OSError: the disk refuses.
    """
    table = field_table(arrays)
    path.mkdir(parents=True)
    attributes = {
        "format": FORMAT,
        "version": SHARD_VERSION,
        "level_ids": [int(level_id) for level_id in level_ids],
        "fields": [field.as_json() for field in table],
    }
    with zarr.config.set({"json_indent": None}):  # of a small shard, half would be blanks
        group = zarr.create_group(path, attributes=attributes)
        for name, values in pack(arrays, table).items():
            blosc = BloscCodec(cname="zstd", clevel=LEVEL, shuffle="shuffle", typesize=values.dtype.itemsize)
            group.create_array(
                name,
                data=values,
                chunks=(1, *values.shape[1:]),
                shards=values.shape,
                compressors=[blosc, Crc32cCodec()],
                dimension_names=("level", "component", "time")[: values.ndim],
                config={"write_empty_chunks": True},
            )
    flush(path)


class Shard:
    """One shard on disk, opened lazily for reading. What it says is checked before anything of it is given out."""

    def __init__(self, path: Path, size: str | None = None) -> None:
        """Open the group at `path`, whose levels are to be of `size`, if that is known.

        Raises:
            Failure: it is missing, damaged, no shard of that or any size, or of another version.
        """
        self.path = path
        try:
            about = json.loads(ordinary_file(path, "zarr.json").read_bytes())
            if (about["zarr_format"], about["node_type"]) != (3, "group"):
                raise ContentsError("it is no group of zarr v3")
            attributes = about["attributes"]
            version = attributes.get("version")
            if attributes.get("format") != FORMAT or version != SHARD_VERSION:
                raise Failure(
                    f"The shard {path} has version {str(version)[:20]}, this program reads {SHARD_VERSION}: "
                    "use the levelproof that wrote it."
                )
            self.size = size_in(attributes["fields"])
            if size not in (None, name_of(self.size)):
                raise ContentsError(f"it has levels of size {name_of(self.size)}, and its row says {size}")
            self.arrays = tuple(dict.fromkeys(field.array for field in table_for(self.size)))
            check_level_ids(attributes["level_ids"])
            self.level_ids: list[int] = attributes["level_ids"]
            self._chunks: dict[str, Chunks] = {}
        except DAMAGE as error:
            raise damaged(path, error) from error

    def read(self, rows: Iterable[int] | None = None, fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Named arrays of `rows` (default: all), level axis last and, for `record/` fields, time first.

        Args:
            rows: rows of the shard, in the order wanted.
            fields: names to return (default: all); arrays without any of them are not read.

        Raises:
            Failure: a chunk is missing or damaged, or holds what a level or a record of this size cannot.
        """
        index = range(len(self.level_ids)) if rows is None else [int(row) for row in rows]
        levels_first = read_together([(self, index)], fields)
        return {name: np.ascontiguousarray(np.moveaxis(x, 0, -1)) for name, x in levels_first.items()}

    def put(self, rows: Sequence[int], packed: Mapping[str, np.ndarray]) -> None:
        """Decode the chunks of these rows into packed arrays, row after row.

        Raises:
            ContentsError, or another of DAMAGE: a chunk is missing or damaged.
        """
        if not all(0 <= row < len(self.level_ids) for row in rows):
            raise ContentsError(f"it has {len(self.level_ids)} rows, and others were asked for")
        for name, values in packed.items():
            if name not in self._chunks:
                shape = (len(self.level_ids), *values.shape[1:])
                self._chunks[name] = Chunks(self.path, name, shape, values.dtype)
            self._chunks[name].read(rows, values)


def read_together(
    parts: Sequence[tuple[Shard, Sequence[int]]], fields: Iterable[str] | None = None
) -> dict[str, np.ndarray]:
    """Named arrays of rows of shards of one size, one part after another; level axis FIRST, then time.

    What a shard holds along time is given as a view of the packed arrays, whose time is the last axis.

    Raises:
        Failure: a chunk is missing or damaged, or holds what a level or a record of this size cannot.
    """
    size, wanted = parts[0][0].size, None if fields is None else set(fields)
    table = [field for field in table_for(size) if wanted is None or field.name in wanted]
    packed = empty(size, dict.fromkeys(field.array for field in table), sum(len(rows) for _, rows in parts))
    lasts = np.cumsum([len(rows) for _, rows in parts]).tolist()
    slices = [slice(last - len(rows), last) for last, (_, rows) in zip(lasts, parts, strict=True)]
    for (shard, rows), mine in zip(parts, slices, strict=True):
        with _reading(shard):
            shard.put(rows, {name: x[mine] for name, x in packed.items()})
    try:
        return _named(packed, table, size)
    except ValueError:  # one of them holds what it cannot
        for (shard, _), mine in zip(parts, slices, strict=True):
            with _reading(shard):
                _named({name: x[mine] for name, x in packed.items()}, table, size)
        raise


def _named(packed: Mapping[str, np.ndarray], table: Sequence[FieldSpec], size: Size) -> dict[str, np.ndarray]:
    arrays = unpack(packed, table)
    check_numbers(arrays, size)
    return arrays


@contextmanager
def _reading(shard: Shard) -> Iterator[None]:
    try:
        yield
    except DAMAGE as error:
        raise damaged(shard.path, error) from error


def damaged(shard: Path, error: Exception) -> Failure:
    """What to say of a shard that raised this when it was read."""
    reason = str(error) if isinstance(error, ContentsError) else type(error).__name__
    return Failure(
        f"The shard {shard} is missing or damaged ({reason}): "
        f"delete {fragment_of(shard)} and run the same `levelproof generate` again to remake its levels."
    )


def open_shard(split: Path, name: str, size: str) -> Shard:
    """The shard that a row of the manifest of `split` names, which is to hold levels of `size`.

    Raises:
        Failure: it is missing, damaged, of another size, or not in the split.
    """
    return Shard(data_path(split, name), size)


def stored_bytes(path: Path) -> int:
    """Bytes of all files of a shard; what links lead to is not its own."""
    about = (entry.lstat() for entry in path.rglob("*"))
    return sum(file.st_size for file in about if stat.S_ISREG(file.st_mode))
