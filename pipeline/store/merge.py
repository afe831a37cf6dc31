"""A shard made of rows of other shards, chunk after chunk: each through its checksum, none decoded.

Knows nothing of what a chunk holds, so every bit comes back, and memory does not grow with the shard. A file of zarr's
sharding codec is its chunks, one after another, and an index: offset and length of each, and a CRC-32C.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import google_crc32c
import numpy as np

from pipeline.errors import Failure
from pipeline.store.chunks import ordinary_file
from pipeline.store.contents import ContentsError
from pipeline.store.disk import flush
from pipeline.store.shard import Shard, damaged, stored_bytes

FILE_BYTES = 64 * 2**20  # that a file has at least, if there is as much; larger: longer indices to read before a chunk
MISSING = 2**64 - 1  # in an index, of a chunk that is not there
CHECKSUM_BYTES = 4


class Place(NamedTuple):
    """Where a trajectory lies."""

    shard: Path
    row: int


class _Source(NamedTuple):
    level_ids: list[int]
    rows_a_file: dict[str, int]  # by array


def merge_shards(
    path: Path, places: Sequence[Place], moved: Callable[[int], None] = lambda _: None, rows_a_file: int | None = None
) -> None:
    """Write the trajectories at these places, in the order of their level ids, to a new shard at `path`, durably.

    Args:
        path: of the new shard.
        places: at least one; all of shards that hold the same fields in the same way.
        moved: called with the bytes of each chunk that was copied; what it raises ends this.
        rows_a_file: rows of each file; default: as few as FILE_BYTES allow, a power of two.

    Raises:
        Failure: a source is damaged, or holds other fields than the first.
        FileExistsError: `path` is there already.
        OSError: the disk refuses.
    """
    documents, sources = _opened(dict.fromkeys(place.shard for place in places))
    if rows_a_file is None:
        rows_a_file = _rows_a_file(sources)
    rows_a_file = min(rows_a_file, len(places))
    group = documents.pop("")
    group["attributes"]["level_ids"] = [sources[of].level_ids[row] for of, row in places]
    path.mkdir(parents=True)
    (path / "zarr.json").write_text(json.dumps(group))
    for name, array in documents.items():
        array["shape"][0] = len(places)
        array["chunk_grid"]["configuration"]["chunk_shape"][0] = rows_a_file
        (path / name).mkdir()
        (path / name / "zarr.json").write_text(json.dumps(array))
        if not np.prod(array["shape"]):
            continue
        axes = len(array["shape"])
        chunks = _chunks(name, axes, places, sources)
        for number, first in enumerate(range(0, len(places), rows_a_file)):
            file = path / _file(name, number, axes)
            file.parent.mkdir(parents=True)
            rows = min(rows_a_file, len(places) - first)
            _write_file(file, (next(chunks) for _ in range(rows)), rows_a_file, moved)
    flush(path)


def _opened(paths: Iterable[Path]) -> tuple[dict[str, Any], dict[Path, _Source]]:
    """The sources, and the metadata that they share, by array (the group's without a name).

    What depends on the number of levels is zero in it.
    """
    first, shared, sources = None, {}, {}
    for path in paths:
        shard = Shard(path)
        try:
            documents = {name: _document(path, name) for name in ("", *shard.arrays)}
            rows = {}
            for name in shard.arrays:
                grid = documents[name]["chunk_grid"]["configuration"]["chunk_shape"]
                rows[name], documents[name]["shape"][0], grid[0] = int(grid[0]), 0, 0
                if rows[name] < 1 or documents[name]["codecs"][0]["configuration"]["codecs"][-1] != {"name": "crc32c"}:
                    raise ContentsError(f"its array {name} is not stored as this program stores it")
            documents[""]["attributes"]["level_ids"] = []
        except Exception as error:  # of JSON that is none, or other than it should be
            raise damaged(path, error) from error
        if first is None:
            first, shared = path, documents
        elif documents != shared:
            raise Failure(f"The shards {first} and {path} hold other fields, so they cannot be merged.")
        sources[path] = _Source(shard.level_ids, rows)
    return shared, sources


def _document(shard: Path, name: str) -> dict[str, Any]:
    return json.loads(ordinary_file(shard, f"{name}/zarr.json" if name else "zarr.json").read_text())


def _rows_a_file(sources: dict[Path, _Source]) -> int:
    stored = sum(stored_bytes(path) for path in sources)
    rows = sum(len(source.level_ids) for source in sources.values())
    return 1 << max(0, int(np.ceil(np.log2(FILE_BYTES * rows / max(stored, 1)))))


def _file(name: str, number: int, axes: int) -> str:
    """Of an array: one that has some of its rows, whole."""
    return "/".join([name, "c", str(number), *"0" * (axes - 1)])


def _chunks(name: str, axes: int, places: Sequence[Place], sources: dict[Path, _Source]) -> Iterator[bytes]:
    """The encoded chunks of an array, each with a checksum that is right."""
    file_of = lambda place: (place.shard, place.row // sources[place.shard].rows_a_file[name])
    for (path, number), of_file in groupby(places, file_of):
        rows_a_file = sources[path].rows_a_file[name]
        try:
            descriptor = os.open(ordinary_file(path, _file(name, number, axes)), os.O_RDONLY)
            try:
                index = _read_index(descriptor, rows_a_file)
                for _, row in of_file:
                    yield _read_chunk(descriptor, *index[row % rows_a_file].tolist())
            finally:
                os.close(descriptor)
        except (OSError, ValueError) as error:
            raise damaged(path, error) from error


def _read_index(descriptor: int, chunks: int) -> np.ndarray:
    """Offset and length of each chunk: (chunk, 2)."""
    length = chunks * 16 + CHECKSUM_BYTES
    end = os.fstat(descriptor).st_size
    if length > end:
        raise ContentsError("a file of it is too short")
    index = np.frombuffer(_checked(os.pread(descriptor, length, end - length)), "<u8").reshape(-1, 2)
    there = index[index[:, 0] != MISSING]
    if (there > end).any():
        raise ContentsError("an index in it leads nowhere")
    return index


def _read_chunk(descriptor: int, offset: int, length: int) -> bytes:
    if offset == MISSING:
        raise ContentsError("a chunk of it is missing")
    chunk = os.pread(descriptor, length, offset)
    _checked(chunk)
    return chunk


def _checked(data: bytes) -> bytes:
    """Without the checksum at its end, which is right."""
    content, end = data[:-CHECKSUM_BYTES], data[-CHECKSUM_BYTES:]
    if _checksum(content) != end:
        raise ContentsError("a checksum is wrong")
    return content


def _checksum(data: bytes) -> bytes:
    return google_crc32c.value(data).to_bytes(CHECKSUM_BYTES, "little")


def _write_file(path: Path, chunks: Iterable[bytes], room: int, moved: Callable[[int], None]) -> None:
    """A file with these chunks, and an index with room for so many."""
    index = np.full((room, 2), MISSING, "<u8")
    with path.open("wb") as file:
        for i, chunk in enumerate(chunks):
            index[i] = file.tell(), len(chunk)
            file.write(chunk)
            moved(len(chunk))
        entries = index.tobytes()
        file.write(entries + _checksum(entries))
