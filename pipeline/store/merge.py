"""Merging rows of shards into a new shard by copying chunks: each is checked by its checksum, none is decoded.

So every bit is preserved, and memory does not grow with the shard. A file of zarr's sharding codec is its chunks, one
after another, and an index: offset and length of each, and a CRC-32C.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import google_crc32c
import numpy as np

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.chunks import CHECKSUM, Chunks, file_name, read_whole
from levelproof.pipeline.store.disk import flush
from levelproof.pipeline.store.formats import ContentsError
from levelproof.pipeline.store.remote import at_once, in_order
from levelproof.pipeline.store.shard import Shard, damaged, reading, stored_bytes

FILE_BYTES = 64 * 2**20  # minimum bytes per file, if there is enough data; larger files have longer indices to read
MISSING = 2**64 - 1  # offset and length of a missing chunk in an index


class Place(NamedTuple):
    """Shard and row that hold a level's trajectory."""

    shard: Path
    row: int
    level_id: int


class _Source(NamedTuple):
    level_ids: np.ndarray
    arrays: dict[str, Chunks]


def merge_shards(
    path: Path, places: Sequence[Place], moved: Callable[[int], None] = lambda _: None, rows_a_file: int | None = None
) -> None:
    """Write trajectories, ordered by level id, to a new shard at `path`, durably.

    Args:
        path: path of the new shard.
        places: at least one; the shards must have equal fields and encodings.
        moved: called with 0 before each shard is opened, and with the bytes of each copied chunk; may raise to stop.
        rows_a_file: rows per file; default: the lowest power of two that reaches FILE_BYTES.

    Raises:
        Failure: a source is damaged, or its fields differ from those of the first.
        FileExistsError: `path` exists.
        OSError: the write fails.
    """
    documents, sources = _opened(dict.fromkeys(place.shard for place in places), moved)
    for shard, row, level_id in places:
        ids = sources[shard].level_ids
        if not 0 <= row < len(ids) or ids[row] != level_id:
            raise damaged(shard, ContentsError(f"its row {row} is not level {level_id}, which the manifest names"))
    if rows_a_file is None:
        rows_a_file = _rows_a_file(sources)
    rows_a_file = min(rows_a_file, len(places))
    group = documents.pop("")
    group["attributes"]["level_ids"] = [place.level_id for place in places]
    path.mkdir(parents=True)
    (path / "zarr.json").write_text(json.dumps(group))
    for name, array in documents.items():
        array["shape"][0] = len(places)
        array["chunk_grid"]["configuration"]["chunk_shape"][0] = rows_a_file
        (path / name).mkdir()
        (path / name / "zarr.json").write_text(json.dumps(array))
        if not np.prod(array["shape"]):
            continue
        chunks = _chunks(name, places, sources)
        for number, first in enumerate(range(0, len(places), rows_a_file)):
            file = path / file_name(name, number, len(array["shape"]))
            file.parent.mkdir(parents=True)
            rows = min(rows_a_file, len(places) - first)
            _write_file(file, (next(chunks) for _ in range(rows)), rows_a_file, moved)
    flush(path)


def _opened(paths: Iterable[Path], moved: Callable[[int], None]) -> tuple[dict[str, Any], dict[Path, _Source]]:
    """Open the sources; return their shared metadata by array (the group's under the empty name), and the sources.

    Entries that depend on the number of levels are zeroed.
    """
    paths, shared, sources = [*paths], {}, {}

    def opened(path: Path) -> tuple[dict[str, Any], _Source]:
        moved(0)
        return _open(path)

    for path, (documents, source) in zip(paths, in_order(paths[0], opened, paths), strict=True):
        shared = shared or documents
        if documents != shared:
            raise Failure(f"The shards {paths[0]} and {path} have different fields, so they cannot be merged.")
        sources[path] = source
    return shared, sources


def _open(path: Path) -> tuple[dict[str, Any], _Source]:
    shard, arrays = Shard(path), {}
    with reading(path):
        files = {"": "zarr.json"} | {name: f"{name}/zarr.json" for name in shard.arrays}
        documents = {name: json.loads(read_whole(path, file)) for name, file in files.items()}
        for name in shard.arrays:
            array = documents[name]
            arrays[name] = Chunks(path, name, tuple(array["shape"]), np.dtype(array["data_type"]))
            array["shape"][0] = array["chunk_grid"]["configuration"]["chunk_shape"][0] = 0
        documents[""]["attributes"]["level_ids"] = []
    return documents, _Source(shard.level_ids, arrays)


def _rows_a_file(sources: dict[Path, _Source]) -> int:
    stored = sum(at_once(next(iter(sources)), stored_bytes, sources))
    rows = sum(len(source.level_ids) for source in sources.values())
    return 1 << max(0, int(np.ceil(np.log2(FILE_BYTES * rows / max(stored, 1)))))


def _chunks(name: str, places: Sequence[Place], sources: dict[Path, _Source]) -> Iterator[bytes]:
    """Yield the encoded chunks of an array."""
    groups = [(path, [place.row for place in group]) for path, group in groupby(places, lambda place: place.shard)]

    def fetched(group: tuple[Path, list[int]]) -> tuple[Path, list[int]]:
        path, rows = group
        with reading(path):
            sources[path].arrays[name].fetch(rows[0])
        return group

    for path, rows in in_order(places[0].shard, fetched, groups):
        with reading(path):
            yield from sources[path].arrays[name].encoded(rows)


def _write_file(path: Path, chunks: Iterable[bytes], room: int, moved: Callable[[int], None]) -> None:
    """Write a file with these chunks and an index of `room` entries."""
    index = np.full((room, 2), MISSING, "<u8")
    with path.open("wb") as file:
        for i, chunk in enumerate(chunks):
            index[i] = file.tell(), len(chunk)
            file.write(chunk)
            moved(len(chunk))
        entries = index.tobytes()
        file.write(entries + google_crc32c.value(entries).to_bytes(CHECKSUM, "little"))
