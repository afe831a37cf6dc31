"""Files opened and written without harm to others, what is on the disk for good, and why a disk refuses."""

import errno
import fcntl
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from levelproof.pipeline.errors import Failure, UserError

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


class NotRegular(UserError):
    """A link, a pipe or the like is where a split has a regular file."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(
            f"{path} must be a regular file without another name, and is a link, a pipe or the like: remove it, then "
            "run the same command again."
        )


def regular(path: str | Path, flags: int, mode: int = 0o666) -> int:
    """Open a regular file, as an `opener` of `open`: for files in a split, which anyone may have made.

    It follows no link at the end of `path`, writes to no file that has another name too, and waits for no pipe.

    Raises:
        NotRegular: it is another kind of file, or has another name.
        OSError: it cannot be opened.
    """
    try:
        how = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(path, flags & ~os.O_TRUNC | how, mode)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO, errno.EISDIR):  # a link; a pipe that no process reads, a socket
            raise NotRegular(path) from None
        raise
    about, writes = os.fstat(descriptor), flags & (os.O_WRONLY | os.O_RDWR)
    if not stat.S_ISREG(about.st_mode) or (writes and about.st_nlink > 1):
        os.close(descriptor)
        raise NotRegular(path)
    if flags & os.O_TRUNC:
        os.ftruncate(descriptor, 0)
    return descriptor


def write_new(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Write a file in place of what has its name, of which no byte changes; the umask narrows `mode`.

    Raises:
        OSError: the disk refuses, or a folder has this name.
    """
    path.unlink(missing_ok=True)
    with open(path, "xb", opener=partial(regular, mode=mode)) as file:
        file.write(data)


@contextmanager
def told_of(split: Path) -> Iterator[None]:
    """For what writes to a split: where the disk refuses, that is said in a sentence.

    Raises:
        Failure: the disk refuses.
    """
    try:
        yield
    except OSError as error:
        if not (sentence := refusal(error, split, REFUSALS | FAILS)):
            raise
        raise Failure(f"{sentence}; nothing is lost.") from error


def refusal(error: OSError, folder: Path, reasons: Mapping[int, str] = REFUSALS) -> str:
    """What the disk refuses and what to do, in a sentence without its end; empty: none of the `reasons`.

    The sentence names the file of the error, which may lie on another disk than `folder`; `folder` if it has none.
    """
    reason, file = reasons.get(error.errno or 0), error.filename
    where = os.fsdecode(file) if isinstance(file, str | bytes | os.PathLike) else folder
    return f"Cannot write to {where}, {reason}, then run the same command again" if reason else ""


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
        to_drive(descriptor)
    finally:
        os.close(descriptor)


def to_drive(descriptor: int) -> None:
    """Have what a descriptor's file holds, or the names in its folder, outlast a loss of power.

    On macOS `fsync` leaves it in the drive's cache, and F_FULLFSYNC does not; not every file system there has that.

    Raises:
        OSError: the disk refuses.
    """
    if full := getattr(fcntl, "F_FULLFSYNC", None):
        try:
            fcntl.fcntl(descriptor, full)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTSUP, errno.EINVAL, errno.ENOTTY):
                raise
    os.fsync(descriptor)
