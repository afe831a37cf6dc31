"""Chunks of one packed array: located in its files, read, checked, and decoded into the caller's buffer.

A file has the layout of zarr's sharding codec: chunks one after another, then an index of their offsets and its
CRC-32C. A chunk is a Blosc buffer and its CRC-32C. zarr-python reads the same bits several times slower: here an index
is read once, and Blosc decodes without Python's global lock, so that threads help.
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

from levelproof.pipeline.store.formats import ContentsError
from levelproof.pipeline.store.remote import RemoteFile, bytes_of
from levelproof.pipeline.urls import is_remote

MAX_METADATA = 2**24  # bytes of a zarr.json; a level takes up to 12
CHECKSUM = 4  # bytes of a CRC-32C
ENTRY = 16  # bytes of a chunk's index entry: its offset and its length
BLOSC_HEADER = Struct("<4xI4xI")  # decoded and encoded bytes of a buffer
CODECS = ["bytes", "blosc", "crc32c"]  # of a chunk


class Chunks:
    """Chunks of one array of a shard. Its first axis is levels, one chunk each."""

    def __init__(self, shard: Path, name: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
        """Check the metadata of the array `name`.

        Raises:
            ContentsError: its shape or type differs, or it is not stored as this program stores arrays.
            OSError, ValueError, KeyError, TypeError: it is missing or damaged.
        """
        self.shard, self.name, self.shape = shard, name, shape
        about = json.loads(read_whole(shard, f"{name}/zarr.json"))
        if [about[key] for key in ("node_type", "shape", "data_type")] != ["array", [*shape], str(dtype)]:
            raise ContentsError(f"its array {name} does not have the shape and type that its fields need")
        self.rows_a_file = _rows_a_file(about, shape)
        if not 1 <= self.rows_a_file <= max(1, shape[0]):
            raise ContentsError(f"its array {name} is not stored as this program stores it")
        self._max_chunk = int(np.prod(shape[1:])) * dtype.itemsize + BLOSC_HEADER.size + CHECKSUM  # bytes
        self._indices: dict[int, np.ndarray] = {}  # by file: [chunk, (first byte, bytes)]
        self._paths: dict[int, str] = {}  # of checked files

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
        """Yield the chunks of these rows as stored, after checking each one's checksum.

        Raises:
            ContentsError, OSError, ValueError: one is missing or damaged.
        """
        for number, mine in groupby(rows, lambda row: row // self.rows_a_file):
            with closing(self._opened(number)) as file:
                spans = self._index(file)[[row % self.rows_a_file for row in mine]].tolist()
                for chunk in file.read(spans):
                    self._checked(chunk)
                    yield chunk

    def fetch(self, row: int) -> None:
        """Have the file of this row in the cache, if it is remote. Raises as `RemoteFile.fetch`."""
        if is_remote(self.shard):
            file = RemoteFile(self.shard / file_name(self.name, row // self.rows_a_file, len(self.shape)))
            file.fetch([(0, file.size)])

    def _opened(self, number: int) -> "LocalFile | RemoteFile":
        name = file_name(self.name, number, len(self.shape))
        if is_remote(self.shard):
            return RemoteFile(self.shard / name)
        if number not in self._paths:
            self._paths[number] = str(regular_file(self.shard, name))
        return LocalFile(self._paths[number])

    def _index(self, file: "LocalFile | RemoteFile") -> np.ndarray:
        end, length = file.size, ENTRY * self.rows_a_file + CHECKSUM
        if length > end:
            raise ContentsError(f"a file of its array {self.name} is cut off")
        (stored,) = file.read([(end - length, length)])
        index = np.frombuffer(self._checked(stored), "<u8").reshape(-1, 2)
        invalid = (index > (end, self._max_chunk)).any(1, keepdims=True)  # beyond the file, or larger than a chunk
        return np.where(invalid, 0, index)  # an empty chunk, which fails its checksum

    def _checked(self, data: bytes) -> bytes:
        """Check the CRC-32C at the end of `data` and strip it."""
        body = data[:-CHECKSUM]
        if len(data) < CHECKSUM or google_crc32c.value(body) != int.from_bytes(data[-CHECKSUM:], "little"):
            raise ContentsError(f"bytes of its array {self.name} are missing or have changed")
        return body

    def _decode(self, stored: bytes, out: np.ndarray) -> None:
        chunk = self._checked(stored)
        if len(chunk) < BLOSC_HEADER.size or BLOSC_HEADER.unpack_from(chunk) != (out.nbytes, len(chunk)):
            raise ContentsError(f"a chunk of its array {self.name} has the wrong size")
        blosc.decompress(chunk, out)


class LocalFile:
    """One file of a shard in a folder, open for reading."""

    def __init__(self, path: str) -> None:
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)

    @property
    def size(self) -> int:
        return os.fstat(self._descriptor).st_size

    def read(self, spans: Iterable[tuple[int, int]]) -> Iterator[bytes]:
        """Yield the bytes of each span (first byte, number of bytes)."""
        return (os.pread(self._descriptor, length, first) for first, length in spans)

    def close(self) -> None:
        os.close(self._descriptor)


def read_whole(shard: Path, name: str) -> bytes:
    """Read a small file of a shard.

    Raises:
        ContentsError, OSError: it is not a regular file, is too large, or cannot be read.
    """
    if is_remote(shard):
        return bytes_of(shard / name, MAX_METADATA)
    path = regular_file(shard, name)
    if path.stat().st_size > MAX_METADATA:
        raise ContentsError(f"its {name} is larger than any shard's")
    return path.read_bytes()


def file_name(array: str, number: int, axes: int) -> str:
    """Path below the shard of an array's file `number`; `axes` counts the array's axes."""
    return "/".join([array, "c", str(number), *"0" * (axes - 1)])


def regular_file(shard: Path, name: str) -> Path:
    """Return the path of a shard's file after checking that it is regular: not a link, nor a pipe, which never ends.

    Raises:
        ContentsError: links lead elsewhere.
        FileNotFoundError: there is no such file.
    """
    path = shard / name
    if path.resolve() != shard.resolve() / name:
        raise ContentsError("it has links to other places")
    if not path.is_file():
        raise FileNotFoundError(path)
    return path


def _rows_a_file(about: dict[str, Any], shape: tuple[int, ...]) -> int:
    """Read the number of levels per file from an array's metadata; 0 if this program does not store arrays this way."""
    grid, (sharding,) = about["chunk_grid"]["configuration"]["chunk_shape"], about["codecs"]
    inside = sharding["configuration"]
    endian = [codec.get("configuration", {}).get("endian", "little") for codec in inside["codecs"]]
    alike = [
        (about["chunk_grid"]["name"], about["chunk_key_encoding"]["name"], sharding["name"])
        == ("regular", "default", "sharding_indexed"),
        about["chunk_key_encoding"].get("configuration", {}).get("separator", "/") == "/",
        inside["chunk_shape"] == [1, *shape[1:]],
        [codec["name"] for codec in inside["codecs"]] == CODECS and set(endian) == {"little"},
        [codec["name"] for codec in inside["index_codecs"]] == ["bytes", "crc32c"],
        inside.get("index_location", "end") == "end" and not about.get("storage_transformers"),
        grid[1:] == [*shape[1:]] and type(grid[0]) is int,
    ]
    return grid[0] if all(alike) else 0
