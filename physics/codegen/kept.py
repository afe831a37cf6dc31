"""What an earlier process made of a kernel, beside JAX's compiled programs: tracing takes half a second, optimising it
seconds."""

import hashlib
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import jax
import llvmlite
import numpy as np
from llvmlite import binding

SOURCES = Path(__file__).parents[1]  # of all that a kernel says, and of what writes it down
BEGAN = time.time() - 5  # s: modules are imported one after another
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


def kept_while_sources_stay(asked: str, make: Callable[[], bytes]) -> bytes:
    """What `make` gives, or gave a process that was `asked` for the same and whose sources and libraries were the same.

    Made in any case where a source has changed since this process began: which one it runs is not known then.
    """
    sources, changed = _sources()
    if changed >= BEGAN:
        return make()
    x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    versions = [sys.version, jax.__version__, np.__version__, llvmlite.__version__]
    return kept("\n".join([sources, *versions, binding.get_default_triple(), str(x64), asked]), make)


@cache
def _sources() -> tuple[str, float]:
    """A hash of their names and bytes, and when the last of them changed."""
    digest, changed = hashlib.sha256(), 0.0
    for path in sorted(SOURCES.rglob("*.py")):
        digest.update(f"{path.relative_to(SOURCES)} {path.stat().st_size}\n".encode() + path.read_bytes())
        changed = max(changed, path.stat().st_mtime)
    return digest.hexdigest(), changed
