"""A work unit's solved levels as one zarr v3 group of packed arrays, as docs/storage.md shows them.

One trajectory is one chunk: larger chunks save under 1% and cost random reads a factor of 3.
"""

import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec

from experts.config import RECORD_STEPS
from levelgen.level import name_of
from pipeline.errors import Failure
from pipeline.store.contents import ContentsError, check_level_ids, check_numbers, size_in, table_for
from pipeline.store.disk import flush
from pipeline.store.layout import data_path, fragment_of
from pipeline.store.packing import pack, unpack
from pipeline.store.schema import ALONG_TIME, PACKED, SHARD_VERSION, field_table

FORMAT = "levelproof.shard"
LEVEL = 5  # of zstd; 9 saves 2% and encodes at 3 MB/s
CODECS = [BytesCodec, BloscCodec, Crc32cCodec]


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
            ordinary_file(path, "zarr.json")
            self._group = zarr.open_group(path, mode="r", zarr_format=3, use_consolidated=False)
            attributes = self._group.attrs.asdict()
            version = attributes.get("version")
            if attributes.get("format") != FORMAT or version != SHARD_VERSION:
                raise Failure(
                    f"The shard {path} has version {str(version)[:20]}, this program reads {SHARD_VERSION}: "
                    "use the levelproof that wrote it."
                )
            self.size = size_in(attributes["fields"])
            if size not in (None, name_of(self.size)):
                raise ContentsError(f"it has levels of size {name_of(self.size)}, and its row says {size}")
            self.table = table_for(self.size)
            self.arrays = tuple(dict.fromkeys(field.array for field in self.table))
            check_level_ids(attributes["level_ids"])
            self.level_ids: list[int] = list(attributes["level_ids"])  # type: ignore[arg-type]
        except Failure:
            raise
        except Exception as error:  # zarr raises many kinds
            raise damaged(path, error) from error

    def read(self, rows: Iterable[int] | None = None, fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Named arrays of `rows` (default: all), level axis last and, for `record/` fields, time first.

        Args:
            rows: rows of the shard, in the order wanted.
            fields: names to return (default: all); arrays without any of them are not read.

        Raises:
            Failure: a chunk is missing or damaged, or holds what a level or a record of this size cannot.
        """
        wanted = None if fields is None else set(fields)
        table = [field for field in self.table if wanted is None or field.name in wanted]
        index = list(range(len(self.level_ids))) if rows is None else [int(row) for row in rows]
        try:
            if not all(0 <= row < len(self.level_ids) for row in index):
                raise ContentsError(f"it has {len(self.level_ids)} rows, and others were asked for")
            packed = {name: self._array(name, index) for name in dict.fromkeys(field.array for field in table)}
            arrays = unpack(packed, table)
            check_numbers(arrays, self.size)
        except Exception as error:  # zarr and its codecs raise many kinds
            raise damaged(self.path, error) from error
        return arrays

    def _array(self, name: str, rows: list[int]) -> np.ndarray:
        ordinary_file(self.path, f"{name}/zarr.json")
        array, dtype = self._group[name], np.dtype(f"u{PACKED[name] // 8}")
        components = sum(field.count for field in self.table if field.array == name)
        shape = (len(self.level_ids), components, *((RECORD_STEPS,) if name in ALONG_TIME else ()))
        if not isinstance(array, zarr.Array) or (array.shape, array.dtype) != (shape, dtype):
            raise ContentsError(f"its array {name} has not the shape and type that its fields need")
        kinds = [type(codec) for codec in (*array.filters, array.serializer, *array.compressors)]
        rows_a_file, *others = array.shards or (0,)
        if (array.chunks, others) != ((1, *shape[1:]), [*shape[1:]]) or kinds != CODECS:
            raise ContentsError(f"its array {name} is not stored as this program stores it")
        for file in sorted({row // rows_a_file for row in rows}) if array.size else ():
            ordinary_file(self.path, "/".join([name, "c", str(file), *"0" * len(others)]))
        index = slice(None) if rows == list(range(shape[0])) else np.asarray(rows, np.intp)
        return np.asarray(array.oindex[index])


def ordinary_file(shard: Path, name: str) -> Path:
    """A file of a shard, here and nowhere else. Of a missing one zarr makes zeros; a pipe never ends.

    Raises:
        ContentsError, FileNotFoundError: it is none.
    """
    path = shard / name
    if path.resolve() != shard.resolve() / name:
        raise ContentsError("it has links to other places")
    if not path.is_file():
        raise FileNotFoundError(path)
    return path


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
