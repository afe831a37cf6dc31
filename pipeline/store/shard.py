"""A work unit's solved levels as one zarr v3 group of packed arrays.

    dyn32 (level, component, 256) uint32   floats and integers that change along time, as bits
    dyn8  (level, component, 256) uint8    flags that change along time
    act   (level, 6, 256)         uint8    actions
    lvl32 (level, component)      uint32   constant within a level
    lvl8  (level, component)      uint8

One trajectory is one chunk (larger chunks save under 1% and cost random reads a factor of 3), all chunks of an
array lie in one file (zarr's sharding codec), compressed with Blosc-zstd 5 after a byte shuffle, each with a
CRC-32C. The group's attributes hold the field table. Measurements: docs/storage.md.
"""

import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from pipeline.errors import Failure
from pipeline.store.layout import fragment_of
from pipeline.store.packing import pack, unpack
from pipeline.store.schema import SHARD_VERSION, FieldPlace, field_table

FORMAT = "levelproof.shard"
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
        "fields": [place.as_json() for place in table],
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
    _flush(path)


class Shard:
    """One shard on disk, opened lazily for reading."""

    def __init__(self, path: Path) -> None:
        """Open the group at `path`.

        Raises:
            Failure: it is missing, damaged, or of another version.
        """
        self.path = path
        try:
            self._group = zarr.open_group(path, mode="r")
            attributes = self._group.attrs.asdict()
            version = attributes.get("version")
            if attributes.get("format") != FORMAT or version != SHARD_VERSION:
                raise Failure(
                    f"The shard {path} has version {version}, this program reads {SHARD_VERSION}: "
                    "use the levelproof that wrote it."
                )
            self.level_ids: list[int] = list(attributes["level_ids"])  # type: ignore[arg-type]
            self.table = [FieldPlace.from_json(entry) for entry in attributes["fields"]]  # type: ignore[union-attr, arg-type]
        except Failure:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def read(self, rows: Iterable[int] | None = None, fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Named arrays of `rows` (default: all), level axis last and, for `record/` fields, time first.

        Args:
            rows: rows of the shard, in the order wanted.
            fields: names to return (default: all); arrays without any of them are not read.

        Raises:
            Failure: a chunk is missing or damaged.
        """
        wanted = None if fields is None else set(fields)
        table = [place for place in self.table if wanted is None or place.name in wanted]
        index = list(range(len(self.level_ids))) if rows is None else [int(row) for row in rows]
        packed = {name: self._array(name, index) for name in dict.fromkeys(place.array for place in table)}
        return unpack(packed, table)

    def _array(self, name: str, rows: list[int]) -> np.ndarray:
        try:
            array = self._group[name]
            assert isinstance(array, zarr.Array)
            # zarr reads a missing file as zeros
            if array.size and not (self.path / name / "c" / "/".join("0" * array.ndim)).is_file():
                raise FileNotFoundError(f"no file for {name}")
            index = slice(None) if rows == list(range(array.shape[0])) else np.asarray(rows, np.intp)
            return np.asarray(array.oindex[index])
        except (OSError, RuntimeError, ValueError, KeyError, AssertionError, zlib.error) as error:
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> Failure:
        return Failure(
            f"The shard {self.path} is missing or damaged ({type(error).__name__}): "
            f"delete {fragment_of(self.path)} and run the same `levelproof generate` again to remake its levels."
        )


def stored_bytes(path: Path) -> int:
    """Bytes of all files of a shard."""
    return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())


def _flush(path: Path) -> None:
    """Everything below `path` to the disk: the fragment that names it may be written only after."""
    for entry in [path, *path.rglob("*"), path.parent]:
        descriptor = os.open(entry, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
