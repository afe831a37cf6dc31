"""Opening and writing files without following links or changing other files, flushing, and errors of failed writes."""

import errno
import fcntl
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from levelproof.pipeline.errors import Failure, UserError

# Errors of writes that would fail again
REFUSALS = {
    errno.ENOSPC: "the disk is full: free some space",
    errno.EDQUOT: "your disk quota is exceeded: free some space",
    errno.EFBIG: "the disk does not allow files this large: choose another folder or raise the limit",
    errno.EROFS: "the disk is read-only: make it writable",
    errno.EACCES: "writing is not permitted: check the folder's permissions",
    errno.EPERM: "writing is not permitted: check the folder's permissions",
}
FAILS = {errno.EIO: "the disk reports an error: see `dmesg`"}  # perhaps only once, so the unit is retried


class NotRegular(UserError):
    """A link, a pipe or the like has the name of a regular file of a split."""

    def __init__(self, path: str | Path) -> None:
        super().__init__(
            f"{path} must be a regular file without other names, but is a link, a pipe or the like: remove it, then "
            "run the same command again."
        )


def regular(path: str | Path, flags: int, mode: int = 0o666) -> int:
    """Open a regular file of a split that others may have made; an `opener` for `open`.

    It does not follow a link at the end of `path`, write to a file with a second name, or wait for a pipe.

    Raises:
        NotRegular: it is another kind of file, or has a second name.
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


def read_regular(path: Path) -> bytes:
    """Read a file that others may have made. Raises as `regular`."""
    with open(path, "rb", opener=regular) as file:
        return file.read()


def write_new(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Replace the file at `path` by a new one. Other names of the old file keep its bytes; the umask narrows `mode`.

    Raises:
        OSError: the write fails, or a folder has this name.
    """
    path.unlink(missing_ok=True)
    with open(path, "xb", opener=partial(regular, mode=mode)) as file:
        file.write(data)


@contextmanager
def explaining_writes(folder: Path, kept: str = "what is committed stays") -> Iterator[None]:
    """Turn errors of failed writes to a folder in the `with` block into a Failure that says what to do.

    `kept` is the clause that says what the failed write has not touched.

    Raises:
        Failure: a write fails.
    """
    try:
        yield
    except OSError as error:
        if not (sentence := refusal(error, folder, REFUSALS | FAILS)):
            raise
        raise Failure(f"{sentence}; {kept}.") from error


def refusal(error: OSError, folder: Path, reasons: Mapping[int, str] = REFUSALS) -> str:
    """Return why a write failed and what to do, a sentence without its full stop; empty if `reasons` lacks the error.

    The sentence names the error's file, which may lie on another disk than `folder`, or else `folder`.
    """
    reason, file = reasons.get(error.errno or 0), error.filename
    where = os.fsdecode(file) if isinstance(file, str | bytes | os.PathLike) else folder
    return f"Cannot write to {where}, because {reason}, then run the same command again" if reason else ""


def flush(path: Path) -> None:
    """Flush a file, or a folder with everything below it; also its name and its parent folder's name.

    Raises:
        OSError: the write fails.
    """
    for entry in [path, *path.rglob("*"), *path.parents[:2]]:
        flush_entry(entry)


def flush_entry(path: Path) -> None:
    """Flush a file's bytes, or the names in a folder.

    Raises:
        OSError: the write fails.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        to_drive(descriptor)
    finally:
        os.close(descriptor)


def to_drive(descriptor: int) -> None:
    """Flush a descriptor's file, or the names in its folder, so that they outlast a loss of power.

    On macOS `fsync` stops at the drive's cache and F_FULLFSYNC does not, but some file systems there lack it.

    Raises:
        OSError: the write fails.
    """
    if full := getattr(fcntl, "F_FULLFSYNC", None):
        try:
            fcntl.fcntl(descriptor, full)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTSUP, errno.EINVAL, errno.ENOTTY):
                raise
    os.fsync(descriptor)
