"""Machine code that an earlier process made, beside JAX's compiled programs: optimising a kernel takes seconds."""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import jax

DIGEST = hashlib.sha256().digest_size  # bytes in front of the code: what a full disk cut short is not executed


def kept(key: str, make: Callable[[], bytes]) -> bytes:
    """What `make` gives, or gave a process with the same key: whatever the code depends on. Kept where JAX keeps its
    programs, if it does; a folder that cannot be read or written costs time and nothing else."""
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not folder or not jax.config.jax_enable_compilation_cache:  # pyright: ignore[reportAttributeAccessIssue]
        return make()
    file = Path(folder) / f"levelproof-{hashlib.sha256(key.encode()).hexdigest()}.kernel"
    with suppress(OSError):
        found = file.read_bytes()
        if hashlib.sha256(found[DIGEST:]).digest() == found[:DIGEST]:
            return found[DIGEST:]
    code = make()
    with suppress(OSError):
        begun = file.with_name(f".{file.name}.{os.getpid()}")
        begun.write_bytes(hashlib.sha256(code).digest() + code)
        begun.replace(file)
    return code
