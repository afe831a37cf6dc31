"""Checksums over every byte that a unit commits, to find damage that no codec detects.

A fragment's metadata has the SHA-256 of each shard and each checkpoint that its rows name. The fragment's own digest
lies in front of parquet's footer: readers follow the footer's offsets, which count from the start, and skip it.
"""

import hashlib
import os
import stat
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path

from levelproof.pipeline.store.remote import at_once, bytes_of, is_listed, stored_at, stored_in
from levelproof.pipeline.urls import is_remote

MARK = b"levelproof.sha256:"  # before a fragment's own digest
OWN = len(MARK) + hashlib.sha256().digest_size
BLOCK = 2**20  # bytes read at once
TAIL = 8  # bytes at the end of a parquet file: the footer's length, and PAR1


def digests_of(path: Path, known: Iterable[str] = ()) -> dict[str, str]:
    """Return the SHA-256 of all files below a folder, by relative path; for a file, its own under the empty path.

    Links, which are not followed, and other entries that are not regular files get a string that is not a digest. On a
    server that does not list files, `known` names them.

    Raises:
        OSError: a file cannot be read.
    """
    if is_remote(path):
        below = stored_in(path) if is_listed(path) else [path / name for name in known if _is_below(name)]
        files = [*below] or [path]
        names = ["" if file == path else file.relative_to(path).as_posix() for file in files]
        return dict(zip(names, at_once(path, _digest, files), strict=True))
    if not stat.S_ISDIR(path.lstat().st_mode):
        return {"": _digest(path)}
    below = sorted(Path(folder, name) for folder, _, names in os.walk(path, onerror=_fail) for name in names)
    return {file.relative_to(path).as_posix(): _digest(file) for file in below}


def digests_below(
    split: Path, names: Iterable[str], carried: Mapping[str, dict[str, str]]
) -> dict[str, dict[str, str]]:
    """Return the digests of the files of the named shards and checkpoints: `carried` ones unchanged, new ones hashed.

    Hashing a kept file again would give its damage a valid digest.
    """
    new = {name: digests_of(split / name) for name in names if name not in carried and (split / name).exists()}
    return dict(sorted(({name: carried[name] for name in names if name in carried} | new).items()))


def _fail(error: OSError) -> None:
    raise error


def _is_below(name: str) -> bool:
    """Whether a relative path stays below its folder."""
    return not (name.startswith("/") or ".." in name.split("/"))


def altered(path: Path, digests: Mapping[str, str], name: str) -> list[str]:
    """Return the relative paths of a shard's files called `name` whose digests differ.

    Raises:
        OSError: a file cannot be read.
    """
    files = [file for file in digests if file.rpartition("/")[2] == name and _is_below(file)]
    if files and is_remote(path):
        stored_at(path / files[0])  # lists the shard once, not once per thread
    actual = at_once(path, lambda file: _digest(path / file), files)
    return [file for file, digest in zip(files, actual, strict=True) if digest != digests[file]]


def _digest(path: Path) -> str:
    if is_remote(path):
        return hashlib.sha256(bytes_of(path)).hexdigest()
    if not stat.S_ISREG(path.lstat().st_mode):
        return "no file"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_own(data: bytes) -> bytes:
    """Insert a parquet file's own digest in front of its footer."""
    footer = _footer(data, len(data))
    return data[:footer] + MARK + hashlib.sha256(data).digest() + data[footer:]


def has_own(path: Path) -> bool:
    """Whether every byte of a parquet file is as `with_own` wrote it.

    Raises:
        OSError: it cannot be read.
    """
    with BytesIO(bytes_of(path)) if is_remote(path) else path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - TAIL))
        start = max(0, _footer(file.read(), size) - OWN)
        digest = hashlib.sha256()
        file.seek(0)
        for first in range(0, start, BLOCK):
            digest.update(file.read(min(BLOCK, start - first)))
        own = file.read(OWN)
        while block := file.read(BLOCK):
            digest.update(block)
    return own == MARK + digest.digest()


def renewed(data: bytes, salt: bytes) -> bytes:
    """Return a parquet file of the same content whose bytes differ: `salt` lies in front of its own digest.

    Raises:
        ValueError: its own digest is wrong; a new one would hide the damage.
    """
    footer = _footer(data, len(data))
    start = max(0, footer - OWN)
    own, plain = data[start:footer], data[:start] + data[footer:]
    if own != MARK + hashlib.sha256(plain).digest():
        raise ValueError("its bytes have changed")
    return with_own(data[:start] + salt + data[footer:])


def _footer(end: bytes, size: int) -> int:
    """Return the offset of the footer of a parquet file of `size` bytes, from its last bytes; 0 if invalid."""
    return max(0, size - TAIL - int.from_bytes(end[-TAIL:][:4], "little"))
