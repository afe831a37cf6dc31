"""Tables in memory-mapped files of the cache folder: the processes of a machine share one copy of their rows.

A file is an Arrow file, the name of its table in the metadata, then a CRC-32C of all that. It appears whole or not at
all; any other file of its name is rewritten. Tables that cannot be written stay in memory.
"""

import mmap
import os
import secrets
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import google_crc32c
import pyarrow as pa

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.store.disk import regular
from levelproof.pipeline.store.pieces import CHECKSUM, TOUCH_INTERVAL, make_room

VERSION = 1  # of these files
FOLDER = "tables"
SUFFIX = ".arrow"
NAME_KEY = b"levelproof.table"
MIN_BYTES = 2**22  # in memory; rereading smaller tables is as fast, and they take little memory
MOST = 10 * 10**9  # bytes of all files; the least recently used ones are deleted first
BLOCK = 2**20  # bytes that are summed at once
DAMAGE = (OSError, ValueError, pa.ArrowException, UserError)  # what another file of this name can raise


def find_table(name: str) -> pa.Table | None:
    """Return a table that a process of this machine has shared under this name; None: there is none."""
    with suppress(*DAMAGE):
        return _opened(_path(name), name)


def share_table(name: str, table: pa.Table) -> pa.Table:
    """Return a large table as a view of a file that other processes find by its name; write the file if it differs."""
    if table.nbytes < MIN_BYTES:
        return table
    if (found := find_table(name)) is not None and found.equals(table):
        return found
    with suppress(*DAMAGE):
        path = _path(name)
        _write(path, name, table)
        return _opened(path, name)
    return table


def whole(column: pa.ChunkedArray) -> Any:
    """Return a column as one array, without a copy if it has one chunk."""
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


def _path(name: str) -> Path:
    return cache_folder() / FOLDER / (sha256(f"{VERSION} {name}".encode()).hexdigest()[:32] + SUFFIX)


def _opened(path: Path, name: str) -> pa.Table:
    """Map a file. Raise one of DAMAGE if it is missing, damaged, or has another table."""
    with open(path, "rb", opener=regular) as file:
        if time.time() - os.fstat(file.fileno()).st_mtime > TOUCH_INTERVAL:
            with suppress(OSError):  # a cache folder that may only be read
                os.utime(path, follow_symlinks=False)
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    content = pa.py_buffer(mapped)
    if content.size <= CHECKSUM or _sum(memoryview(content)[:-CHECKSUM]) != mapped[-CHECKSUM:]:
        raise ValueError("its bytes are not those that were written")
    table = pa.ipc.open_file(content.slice(0, content.size - CHECKSUM)).read_all()
    metadata = dict(table.schema.metadata or {})
    if metadata.pop(NAME_KEY, None) != name.encode():
        raise ValueError("it is another table")
    return table.replace_schema_metadata(metadata or None)


def _write(path: Path, name: str, table: pa.Table) -> None:
    """Write a table in one step. Raise OSError if that fails."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    table = table.combine_chunks().replace_schema_metadata({**(table.schema.metadata or {}), NAME_KEY: name.encode()})
    try:
        with open(temporary, "xb", opener=regular) as file, pa.ipc.new_file(file, table.schema) as writer:
            writer.write_table(table)
        with open(temporary, "r+b", opener=regular) as file:
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                checksum = _sum(memoryview(content))
            file.seek(0, os.SEEK_END)
            file.write(checksum)
        _publish(temporary, path, name, table)
    finally:
        temporary.unlink(missing_ok=True)
    make_room(path.parent, MOST)


def _publish(temporary: Path, path: Path, name: str, table: pa.Table) -> None:
    """Give a written file its name, unless another process was first: all then map one file."""
    try:
        os.link(temporary, path)
        return
    except FileExistsError:
        with suppress(*DAMAGE):
            if _opened(path, name).equals(table):
                return
    except OSError:
        pass  # a file system without hard links
    temporary.replace(path)


def _sum(content: memoryview) -> bytes:
    checksum = google_crc32c.Checksum()
    for first in range(0, len(content), BLOCK):
        checksum.update(bytes(content[first : first + BLOCK]))
    return checksum.digest()
