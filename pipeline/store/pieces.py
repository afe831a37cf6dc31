"""A cache folder for pieces of remote files: bounded, shared by processes, each piece whole or absent."""

import os
import secrets
import time
from contextlib import suppress
from pathlib import Path

import google_crc32c

from levelproof.pipeline.errors import StoreFailure
from levelproof.pipeline.store.disk import NotRegular, regular, write_new

CHECKSUM = 4  # bytes of a CRC-32C after each piece: a loss of power can leave other bytes
TOUCH_INTERVAL = 60.0  # s between updates of a piece's time of use
KEPT_SHARE = 0.9  # share of the bound to which an exceeded cache shrinks
ABANDONED = 3600.0  # s; an older temporary file is from a killed process
MAX_PIECE = 2**24  # bytes
PARTS = 16  # the folder is scanned each time that 1/PARTS of the bound was added


class PieceCache:
    """A folder of pieces whose names identify their bytes: the bytes under a name never change."""

    def __init__(self, folder: Path, most: int) -> None:
        """Keep at most `most` bytes, and up to 1/PARTS more per process that adds pieces."""
        self.folder, self.most = folder, most
        self._added = most  # bytes since the last scan; the first piece triggers one
        self._checked: set[str] = set()  # names whose checksums this process has verified

    def has(self, name: str) -> bool:
        return (self.folder / name).exists()

    def read(self, name: str, first: int, last: int) -> bytes | None:
        """Return bytes of a piece; None: it is missing, or damaged, and then removed if possible."""
        path = self.folder / name
        try:
            descriptor = regular(path, os.O_RDONLY)
        except (OSError, NotRegular):
            return None
        try:
            about = os.fstat(descriptor)
            if about.st_size > MAX_PIECE:
                return None
            if time.time() - about.st_mtime > TOUCH_INTERVAL:
                with suppress(OSError):  # missing, or the folder can only be read
                    os.utime(path, follow_symlinks=False)
            if name in self._checked:
                return os.pread(descriptor, last - first, first)
            data = os.pread(descriptor, about.st_size, 0)
        finally:
            os.close(descriptor)
        piece, checksum = data[:-CHECKSUM], int.from_bytes(data[-CHECKSUM:], "little")
        if len(data) <= CHECKSUM or google_crc32c.value(piece) != checksum:
            with suppress(OSError):
                path.unlink(missing_ok=True)
            return None
        self._checked.add(name)
        return piece[first:last]

    def put(self, name: str, piece: bytes) -> None:
        """Add a piece, which appears whole or not at all.

        Raises:
            StoreFailure: the folder cannot be written.
        """
        temporary = self.folder / f".{name}.{secrets.token_hex(4)}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_new(temporary, piece + google_crc32c.value(piece).to_bytes(CHECKSUM, "little"))
            temporary.replace(self.folder / name)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise StoreFailure(
                f"Cannot write to the cache folder {self.folder} ({error.strerror or error}): "
                "make room there, or set LEVELPROOF_CACHE_DIR to another folder."
            ) from None
        self._checked.add(name)
        self._added += len(piece) + CHECKSUM
        if self._added > self.most // PARTS:
            self._added = 0
            with suppress(OSError):  # such as a folder that another process has deleted
                make_room(self.folder, self.most)


def make_room(folder: Path, most: int) -> None:
    """Above `most` bytes, remove the least recently used files and what killed processes left half-written."""
    files, now = [], time.time()
    with os.scandir(folder) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):
                about = entry.stat(follow_symlinks=False)
                if not entry.name.startswith(".") or now - about.st_mtime > ABANDONED:
                    files.append((about.st_mtime, about.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    if total <= most:
        return
    for _, size, path in sorted(files):
        if total <= KEPT_SHARE * most:
            break
        with suppress(OSError):  # such as another user's file
            with suppress(FileNotFoundError):
                os.unlink(path)
            total -= size
