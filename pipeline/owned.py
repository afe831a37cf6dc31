"""Folders and files that only their user can write to: what lies there is believed, or even executed."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from levelproof.pipeline.errors import UserError

OTHERS = stat.S_IWGRP | stat.S_IWOTH


def own_folder(path: Path, instead: str) -> Path:
    """A folder of this user's own, made if it is not there; where that cannot be, who uses it says so.

    Raises:
        UserError: others can write to it; `instead` is what to do about that.
    """
    if not path.exists():
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
    require_own(path, instead)
    return path


def require_own(path: Path, instead: str) -> None:
    """Refuse what another user has, or can write to; not where systems know no such users.

    Raises:
        UserError: so it is; `instead` is what to do about that.
    """
    if not hasattr(os, "getuid") or not path.exists():
        return
    about = path.stat()
    if about.st_uid not in (os.getuid(), 0):
        raise UserError(f"{path} belongs to another user, and what lies there is believed: {instead}.")
    if about.st_mode & OTHERS:
        raise UserError(f"Other users can write to {path}, and what lies there is believed: {instead}.")
