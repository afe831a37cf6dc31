"""Entries that another user may have planted in a folder in place of a regular file."""

import contextlib
import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.pace import patience
from tests.pipeline.command import COMMAND_SECONDS

MINE = b"export PATH"  # content of the user's own file, outside of that folder


@contextmanager
def no_hang() -> Iterator[None]:
    """Raise TimeoutError in the `with` block if it hangs, as when it waits for a pipe."""

    def expire(*_: Any) -> None:
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, expire)
    signal.alarm(int(patience(COMMAND_SECONDS)))
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def never_hangs() -> Iterator[None]:
    """Run every test of a module that imports this fixture within `no_hang`."""
    with no_hang():
        yield


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    """Write a file of the user outside of the folder that a command gets."""
    path = tmp_path / "profile"
    path.write_bytes(MINE)
    return path


def socket_at(path: Path, _: Path) -> None:
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as one:  # a socket's path must be short
        one.bind(path.name)


PLANTED: dict[str, Callable[[Path, Path], object]] = {
    "link": lambda path, profile: path.symlink_to(profile),
    "link to nothing": lambda path, profile: path.symlink_to(profile.with_name("new")),
    "hard link": lambda path, profile: path.hardlink_to(profile),
    "pipe": lambda path, _: os.mkfifo(path),
    "socket": socket_at,
    "folder": lambda path, _: path.mkdir(),
}
