"""A work unit's solved levels as one zarr v3 group of packed arrays, as docs/shards.md shows.

One trajectory is one chunk: larger chunks save under 1% and slow random reads by a factor of 3.
"""

import json
import os
import stat
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from levelproof.configs.schema import MAX_FRAME_SKIP
from levelproof.levelgen.level import name_of
from levelproof.physics.types import Size
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.bounds import DataUnread
from levelproof.pipeline.store.chunks import Chunks, read_whole
from levelproof.pipeline.store.contents import (
    FULL,
    blank_row,
    check_numbers,
    level_ids_in,
    size_in,
    size_of_levels,
    table_for,
)
from levelproof.pipeline.store.density import Restored, kept, needed, restored
from levelproof.pipeline.store.disk import flush
from levelproof.pipeline.store.fields import same_bits
from levelproof.pipeline.store.formats import FLAT, SHARD_VERSION, ContentsError, Encoding, FieldSpec, field_table
from levelproof.pipeline.store.packing import empty, pack, unpack
from levelproof.pipeline.store.remote import at_once, mended, stored_in
from levelproof.pipeline.urls import is_remote, quoted

FORMAT = "levelproof.shard"
# What reading untrusted bytes can raise
DAMAGE = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, MemoryError, OverflowError)
WRITING = Lock()  # zarr's settings are global: threads write one after another
COMPRESSION: dict[str | None, dict[str, Any]] = {  # by array; None: all others
    FLAT: {"clevel": 9, "shuffle": "noshuffle"},  # a few kilobytes per level, of mixed types
    # Level 9 would save 2% but encode at 3 MB/s; blocks of 512 KiB save 1%
    None: {"clevel": 5, "shuffle": "shuffle", "blocksize": 2**19},
}


class EngineDiffers(UserWarning):
    """On this machine, the engine computes states that differ from the stored ones."""


def write_shard(
    path: Path, level_ids: Sequence[int], arrays: Mapping[str, np.ndarray], encoding: Encoding = FULL
) -> None:
    """Write `arrays` (every field, level axis last, see `pipeline.store.formats`) to a new group at `path`, durably.

    Raises:
        FileExistsError: `path` exists.
        Failure: the engine cannot recompute what this density leaves out.
        OSError: the write fails.
    """
    stored = kept(arrays, encoding)
    if len(stored) < len(arrays):
        _require_restorable(level_ids, arrays, stored, encoding)
    table = field_table(stored, encoding.density)
    path.mkdir(parents=True)
    attributes = {
        "format": FORMAT,
        "version": SHARD_VERSION,
        "level_ids": [int(level_id) for level_id in level_ids],
        **encoding.as_json(),
        "fields": [field.as_json() for field in table],
    }
    with WRITING, zarr.config.set({"json_indent": None}):  # half of a small shard would be blanks
        group = zarr.create_group(path, attributes=attributes)
        for name, values in pack(stored, table).items():
            if name == FLAT:
                values ^= blank_row(size_of_levels(stored), tuple(table))
            blosc = BloscCodec(cname="zstd", typesize=values.dtype.itemsize, **COMPRESSION.get(name, COMPRESSION[None]))
            group.create_array(
                name,
                data=values,
                chunks=(1, *values.shape[1:]),
                shards=values.shape,
                compressors=[blosc, Crc32cCodec()],
                dimension_names=("level", "byte" if name == FLAT else "component", "time")[: values.ndim],
                config={"write_empty_chunks": True},
            )
    flush(path)


def _require_restorable(
    level_ids: Sequence[int], arrays: Mapping[str, np.ndarray], stored: Mapping[str, np.ndarray], encoding: Encoding
) -> None:
    """Raise Failure if arrays cannot be recomputed from what is stored of them."""
    if encoding.rules.frame_skip > MAX_FRAME_SKIP:
        raise Failure(f"An env step has {encoding.rules.frame_skip} physics steps: store records with density=full.")
    recomputed = restored(stored, [field for field in field_table(arrays) if field.name not in stored], encoding)
    for name, values in recomputed.arrays.items():
        if len(wrong := np.flatnonzero(~same_bits(values, arrays[name]))):
            raise Failure(
                f"The engine on this machine cannot recompute {name} of level {level_ids[wrong[0]]}, which "
                f"density={encoding.density} leaves out: use density=full, or the machine and versions that made its "
                "record."
            )


class Shard:
    """One shard, opened lazily for reading. All of its contents are checked before they are returned."""

    def __init__(self, path: str | os.PathLike[str], size: str | None = None) -> None:
        """Open the group at `path`, whose levels must have `size`, if given.

        Raises:
            Failure: it is missing, damaged, not a shard, of another size, or of another version.
        """
        self.path = path = Path(path)
        try:
            about = json.loads(read_whole(path, "zarr.json"))
            if (about["zarr_format"], about["node_type"]) != (3, "group"):
                raise ContentsError("it is not a zarr v3 group")
            attributes = about["attributes"]
            version = attributes.get("version")
            if attributes.get("format") != FORMAT or version != SHARD_VERSION:
                raise DataUnread(
                    f"The shard {path} has version {str(version)[:20]}, but this program reads {SHARD_VERSION}: "
                    "use the levelproof that wrote it."
                )
            self.encoding = Encoding.of(attributes)
            self.size = size_in(attributes["fields"], self.encoding)
            if size not in (None, name_of(self.size)):
                raise ContentsError(f"its levels have size {name_of(self.size)}, but the manifest says {size}")
            self.arrays = tuple(dict.fromkeys(field.array for field in table_for(self.size, self.encoding)))
            self.level_ids = level_ids_in(attributes["level_ids"])
            self._chunks: dict[str, Chunks] = {}
        except DAMAGE as error:
            raise damaged(path, error) from error

    def read(self, rows: Iterable[int] | None = None, fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Read named arrays of `rows` (default: all), level axis last and, for `record/` fields, time first.

        Fields that are not stored are recomputed; warns with EngineDiffers if states differ from the stored ones.

        Args:
            rows: rows of the shard, in any order, which the result keeps.
            fields: names to return (default: all); arrays without any of them are not read.

        Raises:
            Failure: a chunk is missing or damaged, or has values that are invalid for this size.
        """
        index = range(len(self.level_ids)) if rows is None else [int(row) for row in rows]
        levels_first = read_together([(self, index)], fields)
        return {name: np.ascontiguousarray(np.moveaxis(x, 0, -1)) for name, x in levels_first.items()}

    def unlike(self, rows: Sequence[int]) -> np.ndarray:
        """Return each row's first step whose state differs on this machine's engine; -1: none.

        Raises:
            Failure: as `read`.
        """
        return self.restore([(self, rows)], table_for(self.size), [range(len(rows))]).unlike

    def restore(self, parts: Sequence["Part"], table: Sequence[FieldSpec], places: Sequence[Sequence[int]]) -> Restored:
        """Read rows of shards of this class and encoding, level axis first; `places`: positions in the result.

        Raises:
            Failure: as `read`.
        """
        return _read_alike(parts, table, places)

    def put(self, rows: Sequence[int], packed: Mapping[str, np.ndarray], places: Sequence[int]) -> None:
        """Decode the chunks of `rows` into packed arrays, at the positions `places`.

        Raises:
            ContentsError, or another of DAMAGE: a chunk is missing or damaged.
        """
        if not all(0 <= row < len(self.level_ids) for row in rows):
            raise ContentsError(f"it has {len(self.level_ids)} rows, but others were requested")
        for name, values in packed.items():
            if name not in self._chunks:
                shape = (len(self.level_ids), *values.shape[1:])
                self._chunks[name] = Chunks(self.path, name, shape, values.dtype)
            self._chunks[name].read(rows, values, places)


Part = tuple[Shard, Sequence[int]]  # rows of a shard


STATES_DIFFER = "On this machine the engine computes states that differ from the stored ones for"


class Unlike(NamedTuple):
    """Levels of one shard whose states differ on this machine from the stored ones; one or more."""

    shard: Path
    level_ids: list[int]
    steps: list[int]  # the first of each that differs
    read: int  # levels that were read, these included

    def __str__(self) -> str:
        return (
            f"{STATES_DIFFER} {len(self.steps)} of {self.read} levels of the shard {self.shard}, for level "
            f"{self.level_ids[0]} from step {self.steps[0]} on"
        )


Report = Callable[[Sequence[Unlike]], None]  # called if states differ, with one `Unlike` for each shard


def warn_unlike(unlike: Sequence[Unlike]) -> None:
    """Warn, for each shard, that states differ."""
    for one in unlike:
        warnings.warn(f"{one}: between key frames, states are this machine's own.", EngineDiffers, stacklevel=4)


def refuse_unlike(unlike: Sequence[Unlike]) -> None:
    """Raise Failure, because states differ."""
    raise Failure(f"{unlike[0]}: read it with the machine and versions that made it.")


def read_together(
    parts: Sequence[Part],
    fields: Iterable[str] | None = None,
    report: Report = warn_unlike,
    places: Sequence[Sequence[int]] | None = None,
) -> dict[str, np.ndarray]:
    """Read named arrays from rows of several shards of one size; level axis FIRST, then time.

    Fields that are stored along time are views of the packed arrays, whose last axis is time.

    Args:
        parts: shards, and rows to read from each.
        fields: names to return (default: all).
        report: called if states that the engine recomputes differ from stored ones.
        places: positions of each part's rows in the result; default: one part after another.

    Raises:
        Failure: a chunk is missing or damaged, or has values that are invalid for this size; or as `report`.
    """
    wanted = None if fields is None else set(fields)
    table = [field for field in table_for(parts[0][0].size) if wanted is None or field.name in wanted]
    by_encoding: dict[Encoding, list[int]] = {}
    for i, (shard, _) in enumerate(parts):
        by_encoding.setdefault(shard.encoding, []).append(i)
    places = _one_after_another(parts) if places is None else places
    if len(by_encoding) == 1:
        group = parts[0][0].restore(parts, table, places)
        report_unlike(parts, places, group.unlike, report)
        return group.arrays
    groups = []
    for alike in by_encoding.values():
        members = [parts[i] for i in alike]
        groups.append(members[0][0].restore(members, table, _one_after_another(members)))
        report_unlike(members, _one_after_another(members), groups[-1].unlike, report)
    back = np.argsort(np.concatenate([places[i] for alike in by_encoding.values() for i in alike]))
    return {name: np.concatenate([group.arrays[name] for group in groups])[back] for name in groups[0].arrays}


def _read_alike(parts: Sequence[Part], table: Sequence[FieldSpec], places: Sequence[Sequence[int]]) -> Restored:
    """Read rows of shards of one encoding, with each level's first row whose state differs from the stored one."""
    size, encoding = parts[0][0].size, parts[0][0].encoding
    known = table_for(size, encoding)
    names = needed((field.name for field in table), (field.name for field in known))
    chosen = [field for field in known if field.name in names]
    packed = empty(known, dict.fromkeys(field.array for field in chosen), sum(len(rows) for _, rows in parts))

    def put(part: Part, mine: Sequence[int]) -> None:
        with reading(part[0].path):
            part[0].put(part[1], packed, mine)

    at_once(parts[0][0].path, put, parts, places)
    if FLAT in packed:
        packed[FLAT] ^= blank_row(size, known)
    try:
        stored = _named(packed, chosen, size)
    except ValueError:  # find the shard with invalid values
        for (shard, _), mine in zip(parts, places, strict=True):
            with reading(shard.path):
                _named({name: x[np.asarray(mine)] for name, x in packed.items()}, chosen, size)
        raise
    if names == {field.name for field in table}:  # nothing is left to compute
        return Restored({field.name: stored[field.name] for field in table}, np.full(sum(map(len, places)), -1))
    completed = restored({name: np.moveaxis(x, 0, -1) for name, x in stored.items()}, table, encoding)
    return Restored({name: np.moveaxis(x, -1, 0) for name, x in completed.arrays.items()}, completed.unlike)


def _one_after_another(parts: Sequence[Part]) -> list[range]:
    ends = np.cumsum([len(rows) for _, rows in parts]).tolist()
    return [range(end - len(rows), end) for end, (_, rows) in zip(ends, parts, strict=True)]


def report_unlike(parts: Sequence[Part], places: Sequence[Sequence[int]], unlike: np.ndarray, report: Report) -> None:
    """Report the levels whose states differ: those with a first such step, not -1, in `unlike`."""
    found = []
    for (shard, rows), mine in zip(parts, places, strict=True) if (unlike >= 0).any() else ():
        steps = unlike[np.asarray(mine, int)]
        wrong = np.flatnonzero(steps >= 0).tolist()
        if wrong:
            ids = [int(shard.level_ids[rows[i]]) for i in wrong]
            found.append(Unlike(shard.path, ids, steps[wrong].tolist(), len(rows)))
    if found:
        report(found)


def _named(packed: Mapping[str, np.ndarray], table: Sequence[FieldSpec], size: Size) -> dict[str, np.ndarray]:
    arrays = unpack(packed, table)
    check_numbers(arrays, size)
    return arrays


@contextmanager
def reading(shard: Path) -> Iterator[None]:
    """Raise the Failure of a damaged shard for what reading it in the `with` block raises."""
    try:
        yield
    except DAMAGE as error:
        raise damaged(shard, error) from error


def damaged(shard: Path, error: Exception) -> Failure:
    """Return the Failure for a shard that raised `error` when it was read."""
    reason = str(error) if isinstance(error, ContentsError) else type(error).__name__
    return Failure(
        f"The shard {shard} is missing or damaged ({reason}): "
        + mended(shard, f"run `levelproof verify {quoted(shard.parent.parent)} --repair` to regenerate its levels.")
    )


def stored_bytes(path: Path) -> int:
    """Sum the bytes of all files of a shard, not following links."""
    if is_remote(path):
        return sum(about.size for about in stored_in(path).values())
    about = (os.lstat(os.path.join(at, name)) for at, _, names in os.walk(path) for name in names)
    return sum(file.st_size for file in about if stat.S_ISREG(file.st_mode))
