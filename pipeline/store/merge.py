"""A shard made of rows of other shards, chunk after chunk: each through its checksum, none decoded.

Knows nothing of what a chunk holds, so every bit comes back, and memory does not grow with the shard. A file of zarr's
sharding codec is its chunks, one after another, and an index: offset and length of each, and a CRC-32C.
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
from levelproof.pipeline.store.contents import ContentsError
from levelproof.pipeline.store.disk import flush
from levelproof.pipeline.store.shard import DAMAGE, Shard, damaged, stored_bytes

FILE_BYTES = 64 * 2**20  # that a file has at least, if there is as much; larger: longer indices to read before a chunk
MISSING = 2**64 - 1  # in an index, of a chunk that is not there


class Place(NamedTuple):
    """Where the trajectory of a level lies."""

    shard: Path
    row: int
    level_id: int


class _Source(NamedTuple):
    level_ids: list[int]
    arrays: dict[str, Chunks]


def merge_shards(
    path: Path, places: Sequence[Place], moved: Callable[[int], None] = lambda _: None, rows_a_file: int | None = None
) -> None:
    """Write the trajectories at these places, in the order of their level ids, to a new shard at `path`, durably.

    Args:
        path: of the new shard.
        places: at least one; all of shards that hold the same fields in the same way.
        moved: called before each shard is opened, and with the bytes of each chunk that was copied; what it raises
            ends this.
        rows_a_file: rows of each file; default: as few as FILE_BYTES allow, a power of two.

    Raises:
        Failure: a source is damaged, or holds other fields than the first.
        FileExistsError: `path` is there already.
        OSError: the disk refuses.
    """
    documents, sources = _opened(dict.fromkeys(place.shard for place in places), moved)
    for shard, row, level_id in places:
        if sources[shard].level_ids[row : row + 1] != [level_id]:
            raise damaged(shard, ContentsError(f"its row {row} is not level {level_id}, as the manifest says"))
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
    """The sources, and the metadata that they share, by array (the group's without a name).

    What depends on the number of levels is zero in it.
    """
    first, shared, sources = None, {}, {}
    for path in paths:
        moved(0)
        shard, arrays = Shard(path), {}
        try:
            files = {"": "zarr.json"} | {name: f"{name}/zarr.json" for name in shard.arrays}
            documents = {name: json.loads(read_whole(path, file)) for name, file in files.items()}
            for name in shard.arrays:
                of = documents[name]
                arrays[name] = Chunks(path, name, tuple(of["shape"]), np.dtype(of["data_type"]))
                of["shape"][0] = of["chunk_grid"]["configuration"]["chunk_shape"][0] = 0
            documents[""]["attributes"]["level_ids"] = []
        except DAMAGE as error:
            raise damaged(path, error) from error
        if first is None:
            first, shared = path, documents
        elif documents != shared:
            raise Failure(f"The shards {first} and {path} hold other fields, so they cannot be merged.")
        sources[path] = _Source(shard.level_ids, arrays)
    return shared, sources


def _rows_a_file(sources: dict[Path, _Source]) -> int:
    stored = sum(stored_bytes(path) for path in sources)
    rows = sum(len(source.level_ids) for source in sources.values())
    return 1 << max(0, int(np.ceil(np.log2(FILE_BYTES * rows / max(stored, 1)))))


def _chunks(name: str, places: Sequence[Place], sources: dict[Path, _Source]) -> Iterator[bytes]:
    """The encoded chunks of an array."""
    for path, of_shard in groupby(places, lambda place: place.shard):
        try:
            yield from sources[path].arrays[name].encoded(place.row for place in of_shard)
        except DAMAGE as error:
            raise damaged(path, error) from error


def _write_file(path: Path, chunks: Iterable[bytes], room: int, moved: Callable[[int], None]) -> None:
    """A file with these chunks, and an index with room for so many."""
    index = np.full((room, 2), MISSING, "<u8")
    with path.open("wb") as file:
        for i, chunk in enumerate(chunks):
            index[i] = file.tell(), len(chunk)
            file.write(chunk)
            moved(len(chunk))
        entries = index.tobytes()
        file.write(entries + google_crc32c.value(entries).to_bytes(CHECKSUM, "little"))
