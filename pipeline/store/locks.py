"""Locks between processes, held by open files: the system frees them when a process dies, however it dies. Where a
split is in an object store, which has no locks, `leases` and `publish` do what they do.

Lock files are opened for reading and writing: NFS makes these locks out of others, and takes a shared one only of a
file that may be read, an exclusive one only of a file that may be written. Whoever takes one gets LockRefused where
the file system has no locks.
"""

import fcntl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.disk import NotRegular, regular
from levelproof.pipeline.store.layout import COMMIT_LOCK, WRITER_LOCK
from levelproof.pipeline.store.leases import is_leased, leased, named, require_served
from levelproof.pipeline.store.publish import publishing
from levelproof.pipeline.store.remote import is_remote

PATIENCE = 1.0  # s; `is_written` holds the writer's lock for a moment
NOTICE = 2.0  # s of waiting after which people are told for what
POLL = 0.05  # s between two tries


class LockRefused(UserError):
    """The file system has no locks."""


@contextmanager
def only_writer(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Held by the one `levelproof generate` that may write to a split; `say` is told what is waited for.

    Raises:
        UserError: another one is at work, or the lock is not a regular file.
        LeaseLost: another one is, by now.
    """
    if is_remote(split):
        with leased(split, say):
            yield
        return
    with open(split / WRITER_LOCK, "a+", opener=regular) as file:
        if not _taken_within(PATIENCE, file):
            raise UserError(f"Another `levelproof generate` is writing to {split}: wait for it, or stop it first.")
        with named(split, file):
            yield


@contextmanager
def committing(split: Path) -> Iterator[Path]:
    """Held while a unit writes its shard and its fragment, to the folder that it gives; many units may at once.

    A writer names itself before it waits for nobody to commit (`nobody_commits`), so a worker of an earlier one has
    either committed by then, or finds another name here.

    Raises:
        LeaseLost: the writer for whom this process works is not that of the split any more.
        UserError, StoreFailure: as `publishing`, where the split is in a store.
    """
    if is_remote(split):
        with publishing(split) as folder:
            yield folder
        return
    with open(split / COMMIT_LOCK, "a+", opener=regular) as file:
        _take(file, fcntl.LOCK_SH)
        require_served(split)
        yield split


@contextmanager
def nobody_commits(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Waits until no unit is between its shard and its fragment, such as one of a killed run that is still ending.

    `say` is told what is waited for, when that takes long. In a store nobody is waited for (`publish.ended`).
    """
    if is_remote(split):
        yield
        return
    path = split / COMMIT_LOCK
    with open(path, "a+", opener=regular) as file:
        if not _taken_within(NOTICE, file):
            say(
                f"Waiting for a worker of an earlier run, which still writes and holds {path}: "
                f"if it does not end, find it with `fuser -v {path}` on its machine and stop it."
            )
            _take(file, fcntl.LOCK_EX)
        yield


def is_written(split: Path, say: Callable[[str], None] = lambda _: None) -> bool:
    """Whether a `levelproof generate` is running on this split now; writes nothing, and needs to read only.

    `say` is told what is waited for, when that takes long, as it does only in a store.
    """
    if is_remote(split):
        return is_leased(split, say)
    try:
        with open(split / WRITER_LOCK, opener=regular) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (OSError, NotRegular) as error:  # of other kinds: never written to, not ours to ask, or no lock
        return isinstance(error, BlockingIOError)
    return False


def _taken_within(seconds: float, file: IO[str]) -> bool:
    """Whether the exclusive lock was free before these seconds were over."""
    end = time.monotonic() + seconds
    while not _take(file, fcntl.LOCK_EX | fcntl.LOCK_NB):
        if time.monotonic() > end:
            return False
        time.sleep(POLL)
    return True


def _take(file: IO[str], how: int) -> bool:
    """Take a lock; False where another process holds it and `how` is not to wait."""
    try:
        fcntl.flock(file, how)
    except BlockingIOError:
        return False
    except OSError as error:
        raise LockRefused(
            f"The file system of {file.name} refuses locks ({error.strerror}): "
            "choose a folder on another one with out=NAME, or have it mounted with locks."
        ) from error
    return True
