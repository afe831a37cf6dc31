"""Locks between processes, held by open files: the system frees them when a process dies, however it dies."""

import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from pipeline.store.layout import COMMIT_LOCK, WRITER_LOCK

PATIENCE = 1.0  # s; `is_written` holds the writer's lock for a moment


class Locked(Exception):
    """Another process holds the lock."""


@contextmanager
def only_writer(split: Path) -> Iterator[None]:
    """Held by the one `levelproof generate` that may write to a split.

    Raises:
        Locked: another one is at work.
    """
    end = time.monotonic() + PATIENCE
    with (split / WRITER_LOCK).open("a") as file:
        while not _take(file):
            if time.monotonic() > end:
                raise Locked
            time.sleep(PATIENCE / 20)
        yield


def _take(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def committing(split: Path) -> Iterator[None]:
    """Held while a unit writes its shard and its fragment; many units may at once."""
    with (split / COMMIT_LOCK).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        yield


@contextmanager
def nobody_commits(split: Path) -> Iterator[None]:
    """Waits until no unit is between its shard and its fragment, such as one of a killed run that is still ending."""
    with (split / COMMIT_LOCK).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def is_written(split: Path) -> bool:
    """Whether a `levelproof generate` is at work on this split now; takes nothing and writes nothing."""
    try:
        with (split / WRITER_LOCK).open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # never written to, or not ours to ask
        return False
    return False
