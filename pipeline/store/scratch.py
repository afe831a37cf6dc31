"""Temporary folders, each locked by its process; later processes remove unlocked ones, which killed processes left.

A folder has a lock file, which names its machine, and `files` for its owner; what else lies there is removed with it.
Only folders of this user and this machine are removed: on a shared file system, locks may be valid on one machine
alone.
"""

import fcntl
import json
import os
import shutil
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import gettempdir, mkdtemp

from levelproof.pipeline.store.machine import boot_id
from levelproof.pipeline.urls import is_remote

PREFIX = "levelproof-scratch-"
LOCK, FILES = "lock", "files"
MAX_ABOUT = 2**12  # bytes of a lock file


@contextmanager
def scratch(parent: Path | None = None, prefix: str = PREFIX) -> Iterator[Path]:
    """Yield an empty folder that exists for the block.

    The first call of a process removes what killed processes left under this prefix.

    Args:
        parent: folder to create it in (default: the system's folder for temporary files).
        prefix: start of the folder's name; the names of other files must not start with it.

    Raises:
        OSError: the write fails.
    """
    parent = parent or Path(gettempdir())
    _sweep_once(parent, prefix)
    folder, lock = _made(parent, prefix)
    try:
        yield folder / FILES
    finally:
        _remove(folder)
        os.close(lock)


def written_disk(split: Path) -> Path:
    """Return the folder whose disk receives a process's writes: for a split in a store, that of temporary files."""
    return Path(gettempdir()) if is_remote(split) else split


def _made(parent: Path, prefix: str) -> tuple[Path, int]:
    """Make a folder; return it with the descriptor that holds its lock. Retries if another process sweeps it first."""
    while True:
        folder = Path(mkdtemp(prefix=prefix, dir=parent))
        with suppress(FileNotFoundError):  # another process swept the folder
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                with suppress(OSError):  # without locks, no process can sweep it either
                    fcntl.flock(lock, fcntl.LOCK_EX)
                os.write(lock, json.dumps(_machine()).encode())
                if _is_at(lock, folder / LOCK):
                    (folder / FILES).mkdir()
                    return folder, lock
            except BaseException:
                _remove(folder)
                os.close(lock)
                raise
            os.close(lock)


@cache
def _sweep_once(parent: Path, prefix: str) -> None:
    with suppress(OSError), os.scandir(parent) as entries:  # a folder that cannot be listed is not swept
        for entry in entries:
            if entry.name.startswith(prefix) and entry.is_dir(follow_symlinks=False):
                with suppress(OSError):  # other processes sweep, too
                    _sweep(Path(entry.path))


def _sweep(folder: Path) -> None:
    """Remove a folder if its process is dead. Raises OSError if that fails or cannot be known."""
    if folder.lstat().st_uid != os.getuid():
        return
    try:
        lock = os.open(folder / LOCK, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        folder.rmdir()  # if empty; a process that has just made it retries
        return
    try:
        about = os.fstat(lock)
        if not stat.S_ISREG(about.st_mode) or about.st_uid != os.getuid():
            return
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_empty = not (folder / FILES).exists()  # the process died before it wrote anything
        if _is_at(lock, folder / LOCK) and (is_empty or _is_here(os.read(lock, MAX_ABOUT))):
            _remove(folder)
    finally:
        os.close(lock)


def _remove(folder: Path) -> None:
    """Remove a folder whose lock is held. If files remain, the lock file does too, so that a later sweep finds it."""
    with suppress(OSError):
        for entry in folder.iterdir():
            if entry.name != LOCK:
                shutil.rmtree(entry, ignore_errors=True)
        if {entry.name for entry in folder.iterdir()} <= {LOCK}:
            (folder / LOCK).unlink(missing_ok=True)
            folder.rmdir()


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _machine() -> dict[str, str]:
    return {"host": socket.gethostname(), "boot": boot_id()}


def _is_here(about: bytes) -> bool:
    """Whether a lock file names this machine, by its boot id or, if it has none, by its host name, which is not unique.

    Folders from before a reboot stay: they may belong to another machine with the same host name.
    """
    try:
        theirs = json.loads(about)
    except ValueError:
        return False
    own, name = _machine(), "boot" if boot_id() else "host"
    return isinstance(theirs, dict) and bool(own[name]) and theirs.get(name) == own[name]
