"""Pieces of files that lie elsewhere, kept in a folder: bounded, shared by processes, each whole or not there."""

import os
import secrets
import time
from contextlib import suppress
from pathlib import Path

import google_crc32c

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.disk import NotRegular, regular, write_new

CHECKSUM = 4  # bytes of a CRC-32C behind each piece: a machine that lost its power may have kept other bytes
USED = 60.0  # s; a piece is marked as used once in this time
LEFT = 0.9  # share of the bound that is left when it was exceeded
ABANDONED = 3600.0  # s; who writes a piece for longer was killed
MAX_PIECE = 2**24  # bytes
PARTS = 16  # the folder is looked through each time that this part of the bound was added


class PieceCache:
    """A folder of pieces under names that say what is in them: a name's bytes never change."""

    def __init__(self, folder: Path, most: int) -> None:
        """`most` bytes are kept, a sixteenth more by each process that adds pieces."""
        self.folder, self.most = folder, most
        self._added = most  # the first piece looks what is there
        self._checked: set[str] = set()  # names whose bytes this process has seen to be right

    def has(self, name: str) -> bool:
        return (self.folder / name).exists()

    def read(self, name: str, first: int, last: int) -> bytes | None:
        """Bytes of a piece; None: it is not there, or was damaged and is not there any more."""
        path = self.folder / name
        try:
            descriptor = regular(path, os.O_RDONLY)
        except (OSError, NotRegular):
            return None
        try:
            about = os.fstat(descriptor)
            if about.st_size > MAX_PIECE:
                return None
            if time.time() - about.st_mtime > USED:
                os.utime(path, follow_symlinks=False)
            if name in self._checked:
                return os.pread(descriptor, last - first, first)
            data = os.pread(descriptor, about.st_size, 0)
        except FileNotFoundError:  # another process made room
            return None
        finally:
            os.close(descriptor)
        piece, checksum = data[:-CHECKSUM], int.from_bytes(data[-CHECKSUM:], "little")
        if len(data) <= CHECKSUM or google_crc32c.value(piece) != checksum:
            path.unlink(missing_ok=True)
            return None
        self._checked.add(name)
        return piece[first:last]

    def put(self, name: str, piece: bytes) -> None:
        """Keep a piece, which appears at once or not at all.

        Raises:
            Failure: the folder cannot be written.
        """
        temporary = self.folder / f".{name}.{secrets.token_hex(4)}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_new(temporary, piece + google_crc32c.value(piece).to_bytes(CHECKSUM, "little"))
            temporary.replace(self.folder / name)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise Failure(
                f"Cannot write to the cache folder {self.folder} ({error.strerror or error}): "
                "make room there, or set LEVELPROOF_CACHE_DIR to another folder."
            ) from None
        self._checked.add(name)
        self._added += len(piece) + CHECKSUM
        if self._added > self.most // PARTS:
            self._added = 0
            self._make_room()

    def _make_room(self) -> None:
        """Remove what was not used for longest, and what killed processes left half-written."""
        found, now = [], time.time()
        with os.scandir(self.folder) as entries:
            for entry in entries:
                with suppress(FileNotFoundError):
                    about = entry.stat(follow_symlinks=False)
                    if not entry.name.startswith(".") or now - about.st_mtime > ABANDONED:
                        found.append((about.st_mtime, about.st_size, entry.path))
        total = sum(size for _, size, _ in found)
        if total <= self.most:
            return
        for _, size, path in sorted(found):
            if total <= LEFT * self.most:
                break
            with suppress(FileNotFoundError):
                os.unlink(path)
            total -= size
