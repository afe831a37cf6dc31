"""Checksums over every byte of what a unit commits, so that damage that no codec would see is found, too.

A fragment has the SHA-256 of each shard and each checkpoint that its rows name, in its metadata, and its own in front
of parquet's footer: readers go to places that the footer names, counted from the beginning, and never look there.
"""

import hashlib
import os
import stat
from pathlib import Path

MARK = b"levelproof.sha256:"  # before a fragment's own digest
OWN = len(MARK) + hashlib.sha256().digest_size
TAIL = 8  # bytes at the end of parquet: how long its footer is, and PAR1


def digest_of(path: Path) -> str:
    """SHA-256 of a file; of a folder, that of what `sha256sum` prints of all files below it, in the order of paths.

    Links are not followed: they, and whatever is no ordinary file, give another digest than any file.

    Raises:
        OSError: it cannot be read.
    """
    if not stat.S_ISDIR(path.lstat().st_mode):
        return _digest_of_file(path)
    below = (Path(folder, name) for folder, _, names in os.walk(path) for name in names)
    names = sorted(os.fsencode(file.relative_to(path)) for file in below)
    lines = (_digest_of_file(path / os.fsdecode(name)).encode() + b"  " + name + b"\n" for name in names)
    return hashlib.sha256(b"".join(lines)).hexdigest()


def _digest_of_file(path: Path) -> str:
    if not stat.S_ISREG(path.lstat().st_mode):
        return "no file"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_own(data: bytes) -> bytes:
    """A parquet file with its own digest in it."""
    footer = _footer(data)
    return data[:footer] + MARK + hashlib.sha256(data).digest() + data[footer:]


def has_own(path: Path) -> bool:
    """Whether every byte of a parquet file is as `with_own` made it.

    Raises:
        OSError: it cannot be read.
    """
    data = path.read_bytes()
    end = _footer(data)
    start = max(0, end - OWN)
    return data[start:end] == MARK + hashlib.sha256(data[:start] + data[end:]).digest()


def _footer(data: bytes) -> int:
    """Where the footer of parquet begins, as its end says; 0 where that cannot be."""
    return max(0, len(data) - TAIL - int.from_bytes(data[-TAIL : 4 - TAIL], "little"))
