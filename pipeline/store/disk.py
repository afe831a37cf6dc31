"""What is on the disk for good, and why a disk refuses."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from levelproof.pipeline.errors import Failure

# The disk refuses: whoever tries again works for nothing.
REFUSALS = {
    errno.ENOSPC: "the disk is full: free some space",
    errno.EDQUOT: "your disk quota is used up: free some space",
    errno.EFBIG: "the disk refuses files this large: choose another folder or raise the limit",
    errno.EROFS: "the disk is read-only: make it writable",
    errno.EACCES: "writing is not permitted: check the folder's permissions",
    errno.EPERM: "writing is not permitted: check the folder's permissions",
}
FAILS = {errno.EIO: "the disk fails: see `dmesg`"}  # or did once, so a unit is tried again


@contextmanager
def told_of(split: Path) -> Iterator[None]:
    """For what writes to a split: where the disk refuses, that is said in a sentence.

    Raises:
        Failure: the disk refuses.
    """
    try:
        yield
    except OSError as error:
        if not (reason := (REFUSALS | FAILS).get(error.errno or 0)):
            raise
        raise Failure(
            f"Cannot write to {split}, {reason}, then run the same command again; nothing is lost."
        ) from error


def flush(path: Path) -> None:
    """A file, or all below a folder, to the disk; and its name, and that of the folder it is in.

    Raises:
        OSError: the disk refuses.
    """
    for entry in [path, *path.rglob("*"), *path.parents[:2]]:
        flush_entry(entry)


def flush_entry(path: Path) -> None:
    """A file, or the names in a folder, to the disk.

    Raises:
        OSError: the disk refuses.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
