"""The writer of a split: its name is in the split's lock file, and who works for another one commits nothing there.

In a folder the system keeps writers apart (`locks`). In an object store a writer renews a lease, and who finds that
silent for long enough takes it.

No clock is compared with another: whoever waits measures by its own. And no time has to be right for a split to stay
whole: a writer that was only slow finds its lease taken, and so do its workers, before they commit anything.
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
from levelproof.pipeline.store.objects import Version, get, put_if
from levelproof.pipeline.store.remote import as_typed, is_remote

SILENCE = 60.0  # s without a renewal after which a writer counts as dead
RENEWAL = 5.0  # s between renewals
SIGHT = 12.0  # s of looking on without a renewal after which no writer is said to be there; two renewals and more
NOTICE = 2.0  # s of waiting after which people are told for what
POLL = 0.5  # s between two looks
MAX_BYTES = 2**16  # of a lock file
RENEWALS = "renewals"  # in a lock's text: of a lease; a folder's lock, which may be copied to a store, has none
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # another one on each machine, and after each start

_served: dict[Path, str] = {}  # the writer of each split for whom this process works


class LeaseLost(Failure):
    """Another writer has taken a split over."""

    def __init__(self, split: Path) -> None:
        gone = f"was silent for {SILENCE:.0f} s" if is_remote(split) else "ended, or its folder was removed"
        super().__init__(
            f"Another command has taken over {as_typed(split)}, because this one {gone}: "
            "nothing more of this one is committed there."
        )


class Lease:
    """Held until it is released, or taken by another writer."""

    def __init__(self, split: Path, say: Callable[[str], None]) -> None:
        """Wait until nobody holds it, and take it.

        Raises:
            UserError: somebody holds it and is at work.
            StoreFailure: the store does not answer.
        """
        self.token, self.lost = secrets.token_hex(8), False
        self._split, self._path, self._renewals = split, split / WRITER_LOCK, 0
        self._version, self._over = _taken(self._path, self._text(), say), threading.Event()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Let the next one have it at once; of a store that does not answer now, it is left to run out."""
        self._over.set()
        self._thread.join(RENEWAL)
        if not (self.lost or self._thread.is_alive()):
            with suppress(LevelproofError):
                self._put(b"{}")

    def _keep(self) -> None:
        while not self._over.wait(RENEWAL):
            self._renewals += 1
            with suppress(LevelproofError):  # a store that is gone is told by who has something to write
                if not self._put(self._text()):
                    self.lost = True
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
                    return

    def _put(self, text: bytes) -> bool:
        """Replace the lock's text; False: another writer has the lease.

        The version that the store has may be that of an older text of this writer, whose answer was lost.
        """
        version = put_if(self._path, text, self._version)
        if version is None and (own := self._own()):
            version = put_if(self._path, text, own)
        self._version = version or self._version
        return version is not None

    def _own(self) -> Version | None:
        """The version that the store has, if this writer put it."""
        try:
            found = get(self._path)
        except FileNotFoundError:
            return None
        return found.version if _said(found.data).get("writer") == self.token else None

    def _text(self) -> bytes:
        return _about(self.token, **{RENEWALS: self._renewals}).encode()


@contextmanager
def leased(split: Path, say: Callable[[str], None]) -> Iterator[None]:
    """The split for this process, and those that work for it, to write to.

    Raises:
        UserError, StoreFailure: as `Lease`.
        LeaseLost: another one has it now.
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
    """Write down in the file of a folder's lock, which this process holds, that it is the writer now.

    Raises:
        OSError: the disk refuses.
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
    """Have this process, and those to which it hands the name, work for this writer in the `with` block."""
    serve(split, writer)
    try:
        yield
    finally:
        del _served[split]


def serve(split: Path, writer: str) -> None:
    """Work from now on for this writer, as the process that is it says. The lock may have another one's name by now."""
    _served[split] = writer


def served(split: Path) -> str:
    """Name the writer of a split for whom this process works, for those that it starts; none is empty."""
    return _served.get(split, "")


def require_served(split: Path) -> None:
    """Raises LeaseLost where the writer for whom this process works is not that of the split any more."""
    served = _served.get(split)
    if served is not None and _writer(split) != served:
        raise LeaseLost(split)


def is_leased(split: Path, say: Callable[[str], None]) -> bool:
    """Whether a writer holds the lease of a split: whether it renews it within SIGHT seconds, by this process's clock.

    `say` is told what is waited for, when that takes long.
    """
    first, begun, notice = b"", 0.0, NOTICE
    while True:
        asked = time.monotonic()
        try:
            found = get(split / WRITER_LOCK, MAX_BYTES).data
        except OSError:  # there is none, or what is there is none
            return False
        holder = _said(found)
        if RENEWALS not in holder or _died_here(holder):
            return False
        if not first:
            first, begun = found, time.monotonic()
        elif found != first:
            return True
        elif asked - begun > SIGHT:
            return False
        elif asked - begun > notice:
            say(f"Looking whether a run still writes to {as_typed(split)}, which takes up to {SIGHT:.0f} s.")
            notice = inf
        time.sleep(POLL)


def _taken(path: Path, text: bytes, say: Callable[[str], None]) -> Version:
    begun = since = time.monotonic()
    before: tuple[str, Version | None] | None = None
    while True:
        try:
            found = get(path)
            holder, version = _said(found.data), found.version
        except FileNotFoundError:
            holder, version = {}, None
        writer, now = str(holder.get("writer", "")), time.monotonic()
        if before and before != (writer, version):
            if writer and before[0] == writer:
                raise UserError(
                    f"Another `levelproof generate` is writing to {as_typed(path.parent)}: wait for it, or stop it."
                )
            since = now
        before = writer, version
        if not writer or now - since > SILENCE or _died_here(holder):
            if mine := put_if(path, text, version):
                return mine
        elif now - begun > NOTICE:
            say(
                f"Waiting whether process {holder.get('pid')} on {holder.get('host')} still writes to "
                f"{as_typed(path.parent)}: after {SILENCE:.0f} s of silence it does not."
            )
            begun = inf
        time.sleep(POLL)


def _writer(split: Path) -> str:
    """The name of the writer that a split has, or had last; nobody's is empty."""
    path = split / WRITER_LOCK
    try:
        data = get(path).data if is_remote(path) else _lock_text(path)
    except (FileNotFoundError, NotRegular):
        return ""
    return str(_said(data).get("writer", "")) if data else ""


def _lock_text(path: Path) -> bytes:
    with open(path, "rb", opener=regular) as file:
        return file.read(MAX_BYTES)


def _about(token: str, **more: int) -> str:
    """A lock file's text."""
    return json.dumps({"writer": token, "host": socket.gethostname(), "pid": os.getpid(), "within": _here(), **more})


def _said(data: bytes) -> dict[str, Any]:
    try:
        found = json.loads(data)
    except ValueError:
        found = None
    return found if isinstance(found, dict) else {"writer": "unknown"}


def _here() -> str:
    """Name the start of this machine and the PID namespace, within which a PID is unique; empty if they are unknown.

    Machines may share a host name, and outside of containers all of them have the same number for the namespace.
    """
    try:
        return f"{BOOT_ID.read_text().strip()} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _died_here(holder: dict[str, Any]) -> bool:
    """Whether a lock's text is of a process of this machine that has ended; False also if that cannot be known."""
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
