"""Compilation claims: of the processes that share a cache folder, one compiles a program and the others wait for it.

A claim is a file lock, which the operating system frees however the process ends.
"""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from jax import monitoring

# s to wait while another process compiles a program; then this one compiles it, too: the other may be suspended, and
# compiling twice costs less than waiting longer
MAX_WAIT = 60.0
POLL = 0.02  # s between attempts to claim


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Hold the claim of this name for the `with` block; wait until no other process holds it.

    After MAX_WAIT s, or if the folder is not writable or does not support locks, the block runs without a claim.
    """
    file = _locked(path)
    try:
        yield
    finally:
        if file is not None:
            with suppress(OSError):
                path.unlink()  # before `close` frees the lock, so that waiting processes claim a new file
            file.close()


def try_claim(path: Path) -> IO[bytes] | None:
    """Return the claim's open file, or None if another process holds it; closing the file ends the claim.

    Raises:
        OSError: the folder is not writable, or does not support locks.
    """
    file = open(path, "ab", opener=_regular)  # noqa: SIM115
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if path.exists() and os.path.samestat(path.stat(), os.fstat(file.fileno())):
            return file
    except BlockingIOError:
        pass
    except OSError:
        file.close()
        raise
    file.close()  # another process holds it, or has just deleted it
    return None


def _locked(path: Path) -> IO[bytes] | None:
    end = time.monotonic() + MAX_WAIT
    with suppress(OSError):
        while time.monotonic() < end:
            if file := try_claim(path):
                return file
            time.sleep(POLL)
    return None


def _regular(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


def share_compiling() -> None:
    """Patch JAX to claim each program that its cache lacks, and to read it if another process compiled it first."""
    from jax._src import compilation_cache, compiler

    compile_and_write = compiler._compile_and_write_cache
    if hasattr(compile_and_write, "claims"):
        return

    def claim_first(backend: Any, module: Any, devices: Any, options: Any, callbacks: Any, name: str, key: str) -> Any:
        if (cache := compilation_cache._get_cache(backend)) is None:
            return compile_and_write(backend, module, devices, options, callbacks, name, key)
        folder = Path(cache._path)  # pyright: ignore[reportAttributeAccessIssue]
        with claimed(folder / f"{key}.claim"):
            if (folder / f"{key}-cache").exists():
                executable, _ = compiler._cache_read(name, key, options, backend, devices)
                if executable is not None:
                    monitoring.record_event("/jax/compilation_cache/cache_hits")  # as JAX does
                    return executable
            return compile_and_write(backend, module, devices, options, callbacks, name, key)

    claim_first.claims = True  # pyright: ignore[reportFunctionMemberAccess]
    compiler._compile_and_write_cache = claim_first
