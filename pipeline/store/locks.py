"""Locks between processes, held by open files: the operating system frees them however a process dies.

Object stores have no locks: there `leases` and `publish` take their place.

Lock files are opened for reading and writing: NFS emulates these locks by byte-range locks, which are shared only on a
readable file and exclusive only on a writable one. Taking a lock raises LockRefused if the file system has no locks.
"""

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.store.disk import NotRegular, regular
from levelproof.pipeline.store.layout import COMMIT_LOCK, WRITER_LOCK
from levelproof.pipeline.store.leases import is_leased, leased, named, require_served
from levelproof.pipeline.store.publish import publishing
from levelproof.pipeline.urls import BUCKETS, is_remote

PATIENCE = 1.0  # s to wait for the writer's lock, because `is_written` holds it for a moment
NOTICE = 2.0  # s of waiting before the user is told the reason
POLL = 0.05  # s between attempts to take a lock


class LockRefused(UserError):
    """The file system has no locks."""


@contextmanager
def only_writer(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Hold the writer lock of a split; passes `say` the reason for a long wait.

    Raises:
        UserError: another writer is active, or the lock is not a regular file.
        LeaseLost: another writer has taken over.
    """
    if is_remote(split):
        with leased(split, say):
            yield
        return
    with open(split / WRITER_LOCK, "a+", opener=regular) as file:
        if not _taken_within(PATIENCE, file):
            raise UserError(f"Another levelproof command is writing to {split}: wait for it, or stop it first.")
        with named(split, file):
            yield


@contextmanager
def only_trainer(folder: Path) -> Iterator[Callable[[], None]]:
    """Hold the writer lock of a policy's folder, which exists; yield a function to call before each write.

    It raises Failure if the folder was removed or recreated, perhaps by a command that now holds its lock.

    Raises:
        UserError: another command is writing to it, its file system has no locks, or the lock is not a
            regular file.
    """
    with open(folder / WRITER_LOCK, "a+", opener=regular) as file:
        try:
            taken = _taken_within(PATIENCE, file)
        except LockRefused:
            raise UserError(
                f"The file system of {folder} has no locks: choose a folder on another one with -o."
            ) from None
        if not taken:
            raise UserError(f"Another command is writing a policy to {folder}: wait for it, or change -o.")

        def require_ours() -> None:
            try:
                is_ours = os.path.samestat(os.fstat(file.fileno()), (folder / WRITER_LOCK).lstat())
            except FileNotFoundError:
                is_ours = False
            if not is_ours:
                raise Failure(f"{folder} was removed or recreated: this command writes nothing more there.")

        yield require_ours


@contextmanager
def committing(split: Path) -> Iterator[Path]:
    """Hold the shared commit lock while a unit writes its shard and its fragment to the yielded folder.

    A new writer writes its token before it waits for commits to end (`without_commits`), so a worker of an earlier
    writer has either committed by then, or finds the new token here.

    Raises:
        LeaseLost: this process works for a writer that no longer has the split.
        UserError, StoreFailure: as `publishing`, if the split is in a store.
    """
    if is_remote(split):
        with publishing(split) as folder:
            yield folder
        return
    require_served(split)  # also here, because the folder may be gone
    with open(split / COMMIT_LOCK, "a+", opener=regular) as file:
        _take(file, fcntl.LOCK_SH)
        require_served(split)
        yield split


@contextmanager
def without_commits(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Exclude commits: wait until no unit is between its shard and its fragment, such as one of a killed run.

    Passes `say` the reason for a long wait. In a store this does not wait (`publish.ended`).
    """
    if is_remote(split):
        yield
        return
    path = split / COMMIT_LOCK
    with open(path, "a+", opener=regular) as file:
        if not _taken_within(NOTICE, file):
            say(
                f"Waiting for a worker of an earlier run that still writes and holds {path}: "
                f"if it does not end, find it with `fuser -v {path}` on its machine and stop it."
            )
            _take(file, fcntl.LOCK_EX)
        yield


def is_written(split: Path, say: Callable[[str], None] = lambda _: None) -> bool:
    """Whether a levelproof command is writing to this split now; needs read access only.

    Nothing writes to web servers and the hub. They are not even asked: many deny files whose names begin with a dot.
    Passes `say` the reason for a long wait, which happens only in a store.
    """
    if is_remote(split):
        return split.parts[0] in BUCKETS and is_leased(split, say)
    try:
        with open(split / WRITER_LOCK, opener=regular) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (OSError, NotRegular) as error:  # others: never written to, unreadable, or no locks
        return isinstance(error, BlockingIOError)
    return False


def _taken_within(seconds: float, file: IO[str]) -> bool:
    """Try for `seconds` to take the exclusive lock; return whether it was free."""
    end = time.monotonic() + seconds
    while not _take(file, fcntl.LOCK_EX | fcntl.LOCK_NB):
        if time.monotonic() > end:
            return False
        time.sleep(POLL)
    return True


def _take(file: IO[str], how: int) -> bool:
    """Take a lock; return False if another process holds it and `how` has LOCK_NB."""
    try:
        fcntl.flock(file, how)
    except BlockingIOError:
        return False
    except OSError as error:
        raise LockRefused(
            f"The file system of {file.name} does not support locks ({error.strerror}): "
            "choose a folder on another one with out=NAME or -o, or have it mounted with locks."
        ) from error
    return True
