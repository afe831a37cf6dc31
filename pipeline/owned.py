"""Folders and files that only their user can write to, because levelproof trusts or even executes their content."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from levelproof.pipeline.errors import UserError

WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def own_folder(path: Path, instead: str) -> Path:
    """Return a folder that only this user can write to; create it if it is missing.

    If it cannot be created, the first use of the folder reports that.

    Raises:
        UserError: other users can write to it; the message ends with `instead`, which says what to do.
    """
    if not path.exists():
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
    require_own(path, instead)
    return path


def require_own(path: Path, instead: str) -> None:
    """Check that another user neither owns a path nor can write to it; do nothing on systems without user ids.

    Raises:
        UserError: another user owns it or can write to it; the message ends with `instead`, which says what to do.
    """
    if not hasattr(os, "getuid") or not path.exists():
        return
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        raise UserError(f"{path} belongs to another user, but levelproof trusts its content: {instead}.")
    if status.st_mode & WRITABLE_BY_OTHERS:
        raise UserError(f"Other users can write to {path}, but levelproof trusts its content: {instead}.")
