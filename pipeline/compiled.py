"""JAX's folder of compiled programs, freed of those that cannot be read.

JAX writes a program in place and never replaces one: what a killed process or a full disk left half-written would be
compiled again, with a warning, at every start.
"""

import contextlib
import os
from pathlib import Path

LOOKED = "looked"  # beside the programs: written when the last look began; what is older was readable


def remove_damaged(folder: Path) -> None:
    """Remove what JAX cannot read. What has not changed since the last look is not read again."""
    from jax._src.compilation_cache import decompress_executable  # what JAX itself does, with the library it chooses

    looked, now = folder / LOOKED, folder / f".{LOOKED}.{os.getpid()}"
    with contextlib.suppress(OSError):  # a folder of somebody else's: JAX says what it cannot read
        now.touch()
        since = looked.stat().st_mtime_ns if looked.exists() else 0
        for path in folder.glob("*-cache"):
            try:
                if path.stat().st_ctime_ns >= since:  # ns; a copy is as young as itself
                    decompress_executable(path.read_bytes())
            except Exception:  # every library has its own
                path.unlink(missing_ok=True)
        now.replace(looked)
