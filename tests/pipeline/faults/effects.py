"""Effects of a process on the files below a folder, counted and reported before they happen; and loss of power, which
undoes a random part of what was not flushed to the disk."""

import fcntl
import os
import random
import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

KINDS = {
    "os.rename": "rename",
    "os.remove": "unlink",
    "os.mkdir": "mkdir",
    "os.rmdir": "rmdir",
    "fcntl.flock": "lock",
    "open": "write",
}
WHOLE = "whole"  # ends each line of the log, because a killed process may leave only the beginning of one
Tell = Callable[[int, str, str], None]  # gets an effect's number, its kind, and a path


class Effects:
    """Counts the effects of this process from now on; at most one per process, as audit hooks cannot be removed."""

    def __init__(self, below: Path, tell: Tell, log: Path | None = None) -> None:
        """`tell` may raise the disk's error; its own effects are not counted. A `log` records effects in order."""
        self.count, self._below, self._log = 0, str(below), log
        self._telling, self._lock = threading.local(), threading.Lock()
        self._fsync = os.fsync
        self.tell = tell
        os.fsync = self._flush
        sys.addaudithook(self._audit)

    def _audit(self, event: str, arguments: tuple) -> None:
        kind = KINDS.get(event)
        if not kind or (kind == "write" and not (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            return
        if kind == "lock" and arguments[1] == fcntl.LOCK_UN:
            return
        # Audit events give a bare name inside a folder that is deleted recursively, and a descriptor for a lock
        path = "" if kind == "lock" else os.fsdecode(arguments[0]) if not isinstance(arguments[0], int) else ""
        if self._below in path or (path and not path.startswith("/")) or kind == "lock":
            self._happen(kind, path, arguments)

    def _flush(self, descriptor: int) -> None:
        path = os.readlink(f"/proc/self/fd/{descriptor}")
        if self._below in path:
            self._happen("fsync", path, ())
        self._fsync(descriptor)

    def _happen(self, kind: str, path: str, arguments: tuple) -> None:
        if getattr(self._telling, "now", False):
            return
        self._telling.now = True
        try:
            with self._lock:
                number, self.count = self.count, self.count + 1
            self.tell(number, kind, path)
            if self._log and path.startswith("/"):
                self._note(number, kind, path, arguments)
        finally:
            self._telling.now = False

    def _note(self, number: int, kind: str, path: str, arguments: tuple) -> None:
        """Append an effect to the log, with a copy of a file that it will delete."""
        assert self._log
        there = os.fsdecode(arguments[1]) if kind == "rename" else path
        saved = ""
        if kind in ("unlink", "rename") and os.path.isfile(there):
            saved = f"{self._log}.{os.getpid()}.{number}"
            shutil.copyfile(there, saved)
        with open(self._log, "a") as file:
            file.write("\n" + "\t".join([kind, path, there, saved, str(os.path.exists(path)), WHOLE]))


class Change(NamedTuple):
    """An effect that was not flushed to the disk."""

    kind: str  # write, create, rename, unlink
    path: Path  # the file whose bytes or name changed
    source: Path  # of a rename
    saved: str  # path of a copy of the file that was there before; empty: none


def lose_power(log: Path, seed: int) -> None:
    """Undo a random half of the unflushed changes to bytes and names, the latest first."""
    loose: list[Change] = []
    for line in log.read_text().splitlines():
        if not line.endswith("\t" + WHOLE):
            continue  # the process died before this effect
        kind, path, there, saved, existed, _ = line.split("\t")
        at = Path(there)
        if kind == "fsync":
            loose = [
                change for change in loose if (change.path if change.kind == "write" else change.path.parent) != at
            ]
        elif kind == "write":
            loose += [Change("write", at, at, "")] + ([] if existed == "True" else [Change("create", at, at, "")])
        elif kind == "rename":
            old = Path(path)
            loose = [c._replace(path=at) if c.path == old and c.kind == "write" else c for c in loose]
            loose.append(Change("rename", at, Path(path), saved))
        elif kind == "unlink" and saved:
            loose.append(Change("unlink", at, at, saved))
    dice = random.Random(seed)
    for kind, path, source, saved in reversed(loose):
        if dice.random() < 0.5 or not path.parent.is_dir():
            continue
        if kind == "write" and path.is_file():
            os.truncate(path, dice.choice([0, path.stat().st_size // 2]))
        elif kind == "create":
            path.unlink(missing_ok=True)
        elif kind == "rename" and path.exists() and not source.exists():
            path.rename(source)
        if kind in ("rename", "unlink") and saved and not path.exists():
            shutil.copyfile(saved, path)
