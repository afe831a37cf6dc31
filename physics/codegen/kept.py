"""A disk cache of kernels, beside JAX's compiled programs: tracing one takes half a second, optimising it seconds."""

import hashlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import jax
import llvmlite
import numpy as np
from llvmlite import binding

BEGAN = time.time() - 5  # s; other modules were imported shortly before this one
DIGEST = hashlib.sha256().digest_size  # bytes before the code: a file cut short by a full disk is not executed


def cached(key: str, make: Callable[[], bytes]) -> bytes:
    """Return `make()`, or its stored result for the same key, which must determine the code.

    Files lie in JAX's compilation cache, if there is one; a folder that cannot be read or written costs only time.
    """
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not folder or not jax.config.jax_enable_compilation_cache:  # pyright: ignore[reportAttributeAccessIssue]
        return make()
    file = Path(folder) / f"levelproof-{hashlib.sha256(key.encode()).hexdigest()}.kernel"
    with suppress(OSError):
        stored = file.read_bytes()
        if hashlib.sha256(stored[DIGEST:]).digest() == stored[:DIGEST]:
            return stored[DIGEST:]
    code = make()
    with suppress(OSError):
        unfinished = file.with_name(f".{file.name}.{os.getpid()}")
        unfinished.write_bytes(hashlib.sha256(code).digest() + code)
        unfinished.replace(file)
    return code


def cached_by_sources(request: str, make: Callable[[], bytes], folders: Sequence[Path]) -> bytes:
    """Return `make()`, or the stored result for the same `request` from the same sources and library versions.

    `folders` hold the sources. If one has changed since this process began, call `make`: which version this process
    imported is unknown.
    """
    digests, changes = zip(*map(_sources, folders), strict=True)
    if max(changes) >= BEGAN:
        return make()
    x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    versions = [sys.version, jax.__version__, np.__version__, llvmlite.__version__]
    return cached("\n".join([*digests, *versions, binding.get_default_triple(), str(x64), request]), make)


@cache
def _sources(folder: Path) -> tuple[str, float]:
    """Return a hash of a folder's sources, names and bytes, and when the last of them changed."""
    digest, changed = hashlib.sha256(), 0.0
    for path in sorted(folder.rglob("*.py")):
        digest.update(f"{path.relative_to(folder)} {path.stat().st_size}\n".encode() + path.read_bytes())
        changed = max(changed, path.stat().st_mtime)
    return digest.hexdigest(), changed
