"""Writing (in one step) and removing single files of a split, in a folder or in a store."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path

from levelproof.pipeline.store import objects
from levelproof.pipeline.store.disk import flush_entry, write_new
from levelproof.pipeline.store.remote import at_once, stored_in
from levelproof.pipeline.urls import is_remote


def write(path: Path, data: bytes, mode: int = 0o666, durable: bool = False) -> None:
    """Write or replace a file in one step; in a folder it gets this mode, less the umask.

    With `durable`, it outlasts a loss of power.

    Raises:
        OSError: the write fails.
        UserError, StoreFailure: the store's request fails.
    """
    if is_remote(path):
        objects.put(path, data)
        return
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write_new(temporary, data, mode)
        if durable:
            flush_entry(temporary)
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)  # a full disk must not stay full because of it
        raise
    if durable:
        flush_entry(path.parent)  # makes the file's name durable


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new, empty file beside `path`, with its suffix, which replaces it when the block ends without an error.

    If `path` is a link, the file that it leads to is replaced.

    Raises:
        OSError: the folder cannot be written.
    """
    path = path.resolve()
    unfinished = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        unfinished.unlink(missing_ok=True)  # perhaps a link to another file
        unfinished.touch(exist_ok=False)
        yield unfinished
        unfinished.replace(path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise


def remove(*paths: Path) -> None:
    """Remove files of one split, if they exist; in a store by one request. Raises as `write`."""
    if paths and is_remote(paths[0]):
        objects.remove(paths)
        return
    for path in paths:
        path.unlink(missing_ok=True)


def remove_data(*paths: Path) -> None:
    """Remove shards or experts as far as possible: on NFS, open files stay until the next run tries again.

    Raises:
        UserError, StoreFailure: the store's request fails.
    """
    if paths and is_remote(paths[0]):
        files = at_once(paths[0], lambda path: stored_in(path) if path.suffix == ".zarr" else [path], paths)
        objects.remove(chain(*files))
        return
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
