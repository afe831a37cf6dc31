"""The chunks of one packed array: found in its files, read by their position, checked, and decoded where they belong.

They lie there as zarr's sharding codec has them: chunks one after another, then an index of their places and its
CRC-32C. A chunk is a Blosc buffer and its CRC-32C. zarr-python would read the same bits, several times slower: here
an index is read once, and Blosc decodes into the caller's buffer without Python's global lock, so that threads help.
"""

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from itertools import groupby
from pathlib import Path
from struct import Struct
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import blosc  # pyright: ignore[reportAttributeAccessIssue]

from levelproof.pipeline.store.contents import ContentsError
from levelproof.pipeline.store.remote import RemoteFile, bytes_of, is_remote

MAX_METADATA = 2**24  # bytes of a zarr.json; a level takes up to 12
CHECKSUM = 4  # bytes of a CRC-32C
ENTRY = 16  # bytes of an index for each chunk: where it starts, and how many bytes it has
BLOSC_HEADER = Struct("<4xI4xI")  # how many bytes a buffer decodes to, and has
KINDS = ["bytes", "blosc", "crc32c"]  # of a chunk's codecs


class Chunks:
    """Of one array of a shard. Its first axis is levels, a chunk each."""

    def __init__(self, shard: Path, name: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
        """Look at what the array `name` says of itself.

        Raises:
            ContentsError: it has another shape or type, or is not stored as this program stores it.
            OSError, ValueError, KeyError, TypeError: it is missing or damaged.
        """
        self.shard, self.name, self.shape = shard, name, shape
        about = json.loads(read_whole(shard, f"{name}/zarr.json"))
        if [about[key] for key in ("node_type", "shape", "data_type")] != ["array", [*shape], str(dtype)]:
            raise ContentsError(f"its array {name} has not the shape and type that its fields need")
        self.rows_a_file = _rows_a_file(about, shape)
        if not 1 <= self.rows_a_file <= max(1, shape[0]):
            raise ContentsError(f"its array {name} is not stored as this program stores it")
        self._most = int(np.prod(shape[1:])) * dtype.itemsize + BLOSC_HEADER.size + CHECKSUM  # bytes of a chunk
        self._indices: dict[int, np.ndarray] = {}  # by file: [chunk, (first byte, bytes)]
        self._paths: dict[int, str] = {}  # by file, of those that were looked at

    def read(self, rows: Sequence[int], out: np.ndarray, places: Sequence[int]) -> None:
        """Decode the chunk of `rows[i]` into `out[places[i]]`; `out` is C-contiguous.

        Raises:
            ContentsError, OSError, ValueError, RuntimeError: a chunk is missing or damaged.
        """
        by_file: dict[int, list[int]] = {}
        for i, row in enumerate(rows if out.size else ()):
            by_file.setdefault(row // self.rows_a_file, []).append(i)
        for number, mine in by_file.items():
            with closing(self._opened(number)) as file:
                if number not in self._indices:
                    self._indices[number] = self._index(file)
                index = self._indices[number][[rows[i] % self.rows_a_file for i in mine]]
                for i, stored in zip(mine, file.read(index.tolist()), strict=True):
                    self._decode(stored, out[places[i]])

    def encoded(self, rows: Iterable[int]) -> Iterator[bytes]:
        """The chunks of these rows as they are stored, each with a checksum that is right.

        Raises:
            ContentsError, OSError, ValueError: one is missing or damaged.
        """
        for number, mine in groupby(rows, lambda row: row // self.rows_a_file):
            with closing(self._opened(number)) as file:
                places = self._index(file)[[row % self.rows_a_file for row in mine]].tolist()
                for chunk in file.read(places):
                    self._checked(chunk)
                    yield chunk

    def _opened(self, number: int) -> "LocalFile | RemoteFile":
        name = file_name(self.name, number, len(self.shape))
        if is_remote(self.shard):
            return RemoteFile(self.shard / name)
        if number not in self._paths:
            self._paths[number] = str(ordinary_file(self.shard, name))
        return LocalFile(self._paths[number])

    def _index(self, file: "LocalFile | RemoteFile") -> np.ndarray:
        end, length = file.size, ENTRY * self.rows_a_file + CHECKSUM
        if length > end:
            raise ContentsError(f"a file of its array {self.name} is cut off")
        (stored,) = file.read([(end - length, length)])
        index = np.frombuffer(self._checked(stored), "<u8").reshape(-1, 2)
        lies = (index > (end, self._most)).any(1, keepdims=True)  # outside of the file, or about how much is read
        return np.where(lies, 0, index)  # as if there were no byte

    def _checked(self, data: bytes) -> bytes:
        """Without the CRC-32C at their end."""
        body = data[:-CHECKSUM]
        if len(data) < CHECKSUM or google_crc32c.value(body) != int.from_bytes(data[-CHECKSUM:], "little"):
            raise ContentsError(f"bytes of its array {self.name} are missing or not those that were written")
        return body

    def _decode(self, stored: bytes, out: np.ndarray) -> None:
        chunk = self._checked(stored)
        if len(chunk) < BLOSC_HEADER.size or BLOSC_HEADER.unpack_from(chunk) != (out.nbytes, len(chunk)):
            raise ContentsError(f"a chunk of its array {self.name} has another size than it should")
        blosc.decompress(chunk, out)


class LocalFile:
    """One file of a shard in a folder, open for reading."""

    def __init__(self, path: str) -> None:
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)

    @property
    def size(self) -> int:
        return os.fstat(self._descriptor).st_size

    def read(self, places: Iterable[tuple[int, int]]) -> Iterator[bytes]:
        """The bytes at these places, first byte and number of bytes, in turn."""
        return (os.pread(self._descriptor, length, first) for first, length in places)

    def close(self) -> None:
        os.close(self._descriptor)


def read_whole(shard: Path, name: str) -> bytes:
    """A small file of a shard.

    Raises:
        ContentsError, OSError: it is no ordinary file, or cannot be read.
    """
    if is_remote(shard):
        return bytes_of(shard / name, MAX_METADATA)
    path = ordinary_file(shard, name)
    if path.stat().st_size > MAX_METADATA:
        raise ContentsError(f"its {name} is larger than that of any shard")
    return path.read_bytes()


def file_name(array: str, number: int, axes: int) -> str:
    """Below a shard: of the file with the chunks of some levels of an array."""
    return "/".join([array, "c", str(number), *"0" * (axes - 1)])


def ordinary_file(shard: Path, name: str) -> Path:
    """A file of a shard, here and nowhere else: no link, and no pipe, which never ends.

    Raises:
        ContentsError, FileNotFoundError: it is none.
    """
    path = shard / name
    if path.resolve() != shard.resolve() / name:
        raise ContentsError("it has links to other places")
    if not path.is_file():
        raise FileNotFoundError(path)
    return path


def _rows_a_file(about: dict[str, Any], shape: tuple[int, ...]) -> int:
    """How many levels the files of an array have, of its metadata; 0 where it is not stored as this program does."""
    grid, (sharding,) = about["chunk_grid"]["configuration"]["chunk_shape"], about["codecs"]
    inside = sharding["configuration"]
    endian = [codec.get("configuration", {}).get("endian", "little") for codec in inside["codecs"]]
    alike = [
        (about["chunk_grid"]["name"], about["chunk_key_encoding"]["name"], sharding["name"])
        == ("regular", "default", "sharding_indexed"),
        about["chunk_key_encoding"].get("configuration", {}).get("separator", "/") == "/",
        inside["chunk_shape"] == [1, *shape[1:]],
        [codec["name"] for codec in inside["codecs"]] == KINDS and set(endian) == {"little"},
        [codec["name"] for codec in inside["index_codecs"]] == ["bytes", "crc32c"],
        inside.get("index_location", "end") == "end" and not about.get("storage_transformers"),
        grid[1:] == [*shape[1:]] and type(grid[0]) is int,
    ]
    return grid[0] if all(alike) else 0
