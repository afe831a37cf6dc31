"""What a process does to the files below a folder: counted, and told before it is done. And a machine's death: what it
had not flushed to the disk is lost, by chance."""

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
WHOLE = "whole"  # ends a line of the log: a process that is killed may have written the beginning of one
Tell = Callable[[int, str, str], None]  # of the number of an effect, its kind, and a path


class Effects:
    """Of this process from now on; one a process, as no audit hook is ever removed."""

    def __init__(self, below: Path, tell: Tell, log: Path | None = None) -> None:
        """`tell` may raise the error that the disk gives; what it does itself is not counted."""
        self.count, self._below, self._log = 0, str(below), log
        self._telling, self._lock = threading.local(), threading.Lock()
        self._fsync = os.fsync
        self.tell = tell
        os.fsync = self._flushed
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple) -> None:
        kind = KINDS.get(event)
        if not kind or (kind == "write" and not (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            return
        if kind == "lock" and arguments[1] == fcntl.LOCK_UN:
            return
        # What is in a folder that goes as a whole goes by its name alone; a lock by its number
        path = "" if kind == "lock" else os.fsdecode(arguments[0]) if not isinstance(arguments[0], int) else ""
        if self._below in path or (path and not path.startswith("/")) or kind == "lock":
            self._happen(kind, path, arguments)

    def _flushed(self, descriptor: int) -> None:
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
        """In a log that is there after this process."""
        assert self._log
        there = os.fsdecode(arguments[1]) if kind == "rename" else path
        saved = ""
        if kind in ("unlink", "rename") and os.path.isfile(there):
            saved = f"{self._log}.{os.getpid()}.{number}"
            shutil.copyfile(there, saved)
        with open(self._log, "a") as file:
            file.write("\n" + "\t".join([kind, path, there, saved, str(os.path.exists(path)), WHOLE]))


class Change(NamedTuple):
    """An effect that is not on the disk for good."""

    kind: str  # write, create, rename, unlink
    path: Path  # whose bytes, or whose name
    source: Path  # of a rename
    saved: str  # what was there before


def lose_power(log: Path, seed: int) -> None:
    """Undo some of what was not flushed, the last first: written bytes, and what names folders have."""
    loose: list[Change] = []
    for line in log.read_text().splitlines():
        if not line.endswith("\t" + WHOLE):
            continue  # what it tells of was not done
        kind, path, there, saved, existed, _ = line.split("\t")
        at = Path(there)
        if kind == "fsync":
            loose = [of for of in loose if (of.path if of.kind == "write" else of.path.parent) != at]
        elif kind == "write":
            loose += [Change("write", at, at, "")] + ([] if existed == "True" else [Change("create", at, at, "")])
        elif kind == "rename":
            loose = [of._replace(path=at) if of.path == Path(path) and of.kind == "write" else of for of in loose]
            loose.append(Change("rename", at, Path(path), saved))
        elif kind == "unlink" and saved:
            loose.append(Change("unlink", at, at, saved))
    dice = random.Random(seed)
    for of in reversed(loose):
        if dice.random() < 0.5 or not of.path.parent.is_dir():
            continue
        if of.kind == "write" and of.path.is_file():
            os.truncate(of.path, dice.choice([0, of.path.stat().st_size // 2]))
        elif of.kind == "create":
            of.path.unlink(missing_ok=True)
        elif of.kind == "rename" and of.path.exists() and not of.source.exists():
            of.path.rename(of.source)
        if of.kind in ("rename", "unlink") and of.saved and not of.path.exists():
            shutil.copyfile(of.saved, of.path)
