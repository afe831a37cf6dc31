"""The writer of a split: the lock file holds its token, and workers of any other writer commit nothing.

In a folder, a file lock excludes a second writer (`locks`). In an object store, a writer renews a lease; another
writer may take it after a long silence.

Clocks are never compared: each process measures waits by its own. A split's integrity depends on no duration: a writer
that was only slow finds its lease taken, as do its workers, before they commit anything.
"""

import json
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import inf
from pathlib import Path
from typing import IO, Any

from levelproof.pipeline.errors import Failure, LevelproofError, UserError
from levelproof.pipeline.store.disk import NotRegular, regular, to_drive
from levelproof.pipeline.store.layout import WRITER_LOCK
from levelproof.pipeline.store.machine import boot_id
from levelproof.pipeline.store.objects import Version, get, put_if
from levelproof.pipeline.urls import as_typed, is_remote

SILENCE = 60.0  # s without a renewal after which a writer counts as dead
RENEWAL = 5.0  # s between renewals
WATCH = 12.0  # s without a renewal after which `is_leased` reports no writer; more than two renewals
NOTICE = 2.0  # s of waiting before the user is told the reason
POLL = 0.5  # s between polls
MAX_BYTES = 2**16  # of a lock file
RENEWALS = "renewals"  # key of leases alone: a folder's lock, which may be copied to a store, does not have it

_served: dict[Path, str] = {}  # by split: token of the writer for whom this process works


class LeaseLost(Failure):
    """Another writer has taken a split over."""

    def __init__(self, split: Path) -> None:
        silent = f"was silent for {SILENCE:.0f} s"
        reason = silent if is_remote(split) else "ended, or its folder was removed"
        super().__init__(
            f"Another command has taken over {as_typed(split)}, because the command that this process works for "
            f"{reason}: this process commits nothing more there."
        )


class Lease:
    """A store's writer lease, held until it is released or another writer takes it."""

    def __init__(self, split: Path, say: Callable[[str], None]) -> None:
        """Wait until no writer holds the lease, and take it.

        Raises:
            UserError: an active writer holds it.
            StoreFailure: the store does not answer.
        """
        self.token, self.lost = secrets.token_hex(8), False
        self._split, self._path, self._renewals = split, split / WRITER_LOCK, 0
        self._version, self._over = _taken(self._path, self._text(), say), threading.Event()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Free the lease for the next writer; if the store does not answer, it expires instead."""
        self._over.set()
        self._thread.join(RENEWAL)
        if not (self.lost or self._thread.is_alive()):
            with suppress(LevelproofError):
                self._put(b"{}")

    def _keep(self) -> None:
        while not self._over.wait(RENEWAL):
            self._renewals += 1
            with suppress(LevelproofError):  # the next write of data reports a store that does not answer
                if not self._put(self._text()):
                    self.lost = True
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                    return

    def _put(self, text: bytes) -> bool:
        """Replace the lock file's content; return False if another writer has the lease.

        The store may have a version that this writer does not know: that of its own request whose response was lost.
        """
        version = put_if(self._path, text, self._version)
        if version is None and (own := self._own()):
            version = put_if(self._path, text, own)
        self._version = version or self._version
        return version is not None

    def _own(self) -> Version | None:
        """Return the store's version, if this writer put it."""
        try:
            lock = get(self._path)
        except FileNotFoundError:
            return None
        return lock.version if _parsed(lock.data).get("writer") == self.token else None

    def _text(self) -> bytes:
        return _about(self.token, **{RENEWALS: self._renewals}).encode()


@contextmanager
def leased(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Hold the lease of a split for this process and its workers.

    Raises:
        UserError, StoreFailure: as `Lease`.
        LeaseLost: another writer has it now.
    """
    lease = Lease(split, say)
    try:
        with serving(split, lease.token):
            yield
    except KeyboardInterrupt:
        if lease.lost:
            raise LeaseLost(split) from None
        raise
    finally:
        lease.release()


@contextmanager
def named(split: Path, lock: IO[str]) -> Iterator[None]:
    """Write a new token of this process to a folder's lock file, whose lock it holds.

    Raises:
        OSError: the write fails.
    """
    token = secrets.token_hex(8)
    lock.truncate(0)
    lock.write(_about(token))
    lock.flush()
    to_drive(lock.fileno())  # workers on other machines read it
    with serving(split, token):
        yield


@contextmanager
def serving(split: Path, writer: str) -> Iterator[None]:
    """Work for this writer in the `with` block, as do processes that get its token from `served`."""
    serve(split, writer)
    try:
        yield
    finally:
        del _served[split]


def serve(split: Path, writer: str) -> None:
    """Work for this writer from now on. The token comes from the writer: the lock file may hold another one by now."""
    _served[split] = writer


def served(split: Path) -> str:
    """Return the token of the writer for whom this process works, to pass to its workers; empty: none."""
    return _served.get(split, "")


def require_served(split: Path) -> None:
    """Raise LeaseLost if this process works for a writer that no longer has the split."""
    served = _served.get(split)
    if served is not None and not is_written_by(split, served):
        raise LeaseLost(split)


def is_leased(split: Path, say: Callable[[str], None]) -> bool:
    """Whether a writer renews the lease of a split within WATCH seconds, by this process's clock.

    Passes `say` the reason for a long wait.
    """
    first, begun, notice = b"", 0.0, NOTICE
    while True:
        asked = time.monotonic()
        try:
            data = get(split / WRITER_LOCK, MAX_BYTES).data
        except OSError:  # missing, or too large for a lock file
            return False
        if not _holder(data):
            return False
        if not first:
            first, begun = data, time.monotonic()
        elif data != first:
            return True
        elif asked - begun > WATCH:
            return False
        elif asked - begun > notice:
            say(f"Checking whether a run still writes to {as_typed(split)}, which takes up to {WATCH:.0f} s.")
            notice = inf
        time.sleep(POLL)


def _taken(path: Path, text: bytes, say: Callable[[str], None]) -> Version:
    begun = since = time.monotonic()
    before: tuple[str, Version | None] | None = None
    while True:
        try:
            lock = get(path)
            holder, version = _holder(lock.data), lock.version
        except FileNotFoundError:
            holder, version = {}, None
        writer, now = str(holder.get("writer", "")), time.monotonic()
        if before and before != (writer, version):
            if writer and before[0] == writer:
                raise UserError(
                    f"Another levelproof command is writing to {as_typed(path.parent)}: wait for it, or stop it first."
                )
            since = now
        before = writer, version
        if not writer or now - since > SILENCE:
            if lock_version := put_if(path, text, version):
                return lock_version
        elif now - begun > NOTICE:
            say(
                f"Waiting to see whether process {holder.get('pid')} on {holder.get('host')} still writes to "
                f"{as_typed(path.parent)}: after {SILENCE:.0f} s of silence, this command takes over."
            )
            begun = inf
        time.sleep(POLL)


def is_written_by(split: Path, writer: str) -> bool:
    """Whether this machine sees that a split's current or last writer has this token; empty: that there was none."""
    path = split / WRITER_LOCK
    try:
        data = get(path).data if is_remote(path) else _lock_text(path)
    except (FileNotFoundError, NotRegular):
        return not writer
    return writer == (str(_parsed(data).get("writer", "")) if data else "")


def _lock_text(path: Path) -> bytes:
    with open(path, "rb", opener=regular) as file:
        return file.read(MAX_BYTES)


def _about(token: str, **more: int) -> str:
    """Return the content of a lock file."""
    return json.dumps({"writer": token, "host": socket.gethostname(), "pid": os.getpid(), "within": _here(), **more})


def _parsed(data: bytes) -> dict[str, Any]:
    """Parse a lock file; the writer of an invalid one is unknown."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        content = None
    return content if isinstance(content, dict) else {"writer": "unknown"}


def _holder(data: bytes) -> dict[str, Any]:
    """Parse a lease; return nothing if no writer can hold it: it was released, or its process has ended here.

    A lock that was copied from a folder is no lease.
    """
    holder = _parsed(data)
    return {} if RENEWALS not in holder or _died_here(holder) else holder


def _here() -> str:
    """Name this machine's boot and the PID namespace, within which a PID is unique; empty if unknown.

    Machines may share a host name, and outside of containers all of them have the same namespace number.
    """
    try:
        return f"{boot} {os.readlink('/proc/self/ns/pid')}" if (boot := boot_id()) else ""
    except OSError:
        return ""


def _died_here(holder: dict[str, Any]) -> bool:
    """Whether the holder is a process of this machine that has ended; False if unknown."""
    pid, here = holder.get("pid"), _here()
    if not here or holder.get("within") != here or type(pid) is not int or pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        pass
    return False
