"""Cleaning JAX's folder of compiled programs.

JAX writes a program in place and never replaces one, so a program that a killed process or a full disk left
half-written would be recompiled, with a warning, at every start.
"""

import contextlib
import os
from pathlib import Path

LAST_CHECK = "looked"  # file beside the programs, touched when a check begins; programs older than it were readable


def remove_damaged(folder: Path) -> None:
    """Delete the programs that JAX cannot read, of those that changed since the last check."""
    from jax._src.compilation_cache import decompress_executable  # as JAX reads them, with the library that it chooses

    last, new = folder / LAST_CHECK, folder / f".{LAST_CHECK}.{os.getpid()}"
    with contextlib.suppress(OSError):  # the folder is not writable: JAX itself warns of damaged programs
        new.touch()
        since = last.stat().st_mtime_ns if last.exists() else 0
        for path in folder.glob("*-cache"):
            try:
                if path.stat().st_ctime_ns >= since:  # ns; ctime, because a copy may keep its original's mtime
                    decompress_executable(path.read_bytes())
            except Exception:  # each compression library raises its own type
                path.unlink(missing_ok=True)
        new.replace(last)
