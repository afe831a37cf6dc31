"""Checksums over every byte of what a unit commits, so that damage that no codec would see is found, too.

A fragment has the SHA-256 of each shard and each checkpoint that its rows name, in its metadata, and its own in front
of parquet's footer: readers go to places that the footer names, counted from the beginning, and never look there.
"""

import hashlib
import os
import stat
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path

from levelproof.pipeline.store.remote import at_once, bytes_of, is_listed, is_remote, stored_in

MARK = b"levelproof.sha256:"  # before a fragment's own digest
OWN = len(MARK) + hashlib.sha256().digest_size
BLOCK = 2**20  # bytes read at once
TAIL = 8  # bytes at the end of parquet: how long its footer is, and PAR1


def digests_of(path: Path, known: Iterable[str] = ()) -> dict[str, str]:
    """SHA-256 of all files below a folder, by their paths there; of a file, its own without a path.

    Links are not followed: they, and whatever else is no ordinary file, have what no file has. On a server that lists
    no files these are the `known` ones.

    Raises:
        OSError: it cannot be read.
    """
    if is_remote(path):
        below = stored_in(path) if is_listed(path) else [path / name for name in known if _is_below(name)]
        files = [*below] or [path]
        found = at_once(path, _digest, files)
        return {
            "" if file == path else file.relative_to(path).as_posix(): of for file, of in zip(files, found, strict=True)
        }
    if not stat.S_ISDIR(path.lstat().st_mode):
        return {"": _digest(path)}
    below = sorted(Path(folder, name) for folder, _, names in os.walk(path) for name in names)
    return {file.relative_to(path).as_posix(): _digest(file) for file in below}


def digests_below(
    split: Path, names: Iterable[str], carried: Mapping[str, dict[str, str]]
) -> dict[str, dict[str, str]]:
    """Digests of the files of shards and checkpoints with these names: those `carried` over as they are, and those of
    new ones from the disk.

    Hashing a file again that stays would make any damage to it the truth.
    """
    there = {name: digests_of(split / name) for name in names if name not in carried and (split / name).exists()}
    return dict(sorted(({name: carried[name] for name in names if name in carried} | there).items()))


def _is_below(name: str) -> bool:
    """Whether it is the path of nothing that is elsewhere."""
    return not (name.startswith("/") or ".." in name.split("/"))


def altered(path: Path, digests: Mapping[str, str], name: str) -> list[str]:
    """Files of a shard, by their paths there, that have this file name and are not what their digests say.

    Raises:
        OSError: one cannot be read.
    """
    files = [file for file in digests if file.rpartition("/")[2] == name and _is_below(file)]
    found = at_once(path, lambda file: _digest(path / file), files)
    return [file for file, digest in zip(files, found, strict=True) if digest != digests[file]]


def _digest(path: Path) -> str:
    if is_remote(path):
        return hashlib.sha256(bytes_of(path)).hexdigest()
    if not stat.S_ISREG(path.lstat().st_mode):
        return "no file"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_own(data: bytes) -> bytes:
    """A parquet file with its own digest in it."""
    footer = _footer(data, len(data))
    return data[:footer] + MARK + hashlib.sha256(data).digest() + data[footer:]


def has_own(path: Path) -> bool:
    """Whether every byte of a parquet file is as `with_own` made it.

    Raises:
        OSError: it cannot be read.
    """
    with BytesIO(bytes_of(path)) if is_remote(path) else path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - TAIL))
        start = max(0, _footer(file.read(), size) - OWN)
        rest = hashlib.sha256()
        file.seek(0)
        for first in range(0, start, BLOCK):
            rest.update(file.read(min(BLOCK, start - first)))
        own = file.read(OWN)
        while block := file.read(BLOCK):
            rest.update(block)
    return own == MARK + rest.digest()


def _footer(end: bytes, size: int) -> int:
    """Where the footer of a parquet file of so many bytes begins, as its end says; 0 where that cannot be."""
    return max(0, size - TAIL - int.from_bytes(end[-TAIL:][:4], "little"))
