"""JAX's folder of compiled programs, freed of those that cannot be read.

JAX writes a program in place and never replaces one: what a killed process or a full disk left half-written would be
compiled again, with a warning, at every start.
"""

import contextlib
import json
import os
from pathlib import Path

READABLE = "readable.json"  # beside the programs: size and time of change of each that was readable at the last look


def remove_damaged(folder: Path) -> None:
    """Remove what JAX cannot read. What has not changed since the last look is not read again."""
    known = _known(folder)
    now = {path.name: _state(path) for path in folder.glob("*-cache")}
    readable = {name: state for name, state in now.items() if known.get(name) == state or _is_readable(folder / name)}
    with contextlib.suppress(OSError):  # a folder of somebody else's: JAX says what it cannot read
        for name in now.keys() - readable.keys():
            (folder / name).unlink(missing_ok=True)
        if readable != known:
            _note(folder, readable)


def _state(path: Path) -> list[int]:
    """Size, bytes, and time of the last change, ns."""
    try:
        found = path.stat()
    except OSError:  # removed meanwhile
        return [0, 0]
    return [found.st_size, found.st_mtime_ns]


def _is_readable(path: Path) -> bool:
    from jax._src.compilation_cache import decompress_executable  # what JAX itself does, with the library it chooses

    try:
        decompress_executable(path.read_bytes())
    except Exception:  # every library has its own
        return False
    return True


def _known(folder: Path) -> dict[str, list[int]]:
    try:
        known = json.loads((folder / READABLE).read_text())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _note(folder: Path, readable: dict[str, list[int]]) -> None:
    temporary = folder / f".{READABLE}.{os.getpid()}"
    temporary.write_text(json.dumps(readable))
    temporary.replace(folder / READABLE)
