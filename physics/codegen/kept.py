"""A disk cache of kernels and of programs with them, beside JAX's own, which has to trace a program to find it."""

import hashlib
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import jax
import llvmlite
import numpy as np
from llvmlite import binding

BEGAN = time.time() - 5  # s since 1970; earlier, as other modules were imported before this one
DIGEST = hashlib.sha256().digest_size  # bytes of a checksum before the code, so that a truncated file is not executed


def cached(key: str, make: Callable[[], bytes]) -> bytes:
    """Return `make()`, or its stored result for the same key, which must determine the code.

    Files lie in JAX's compilation cache, if there is one; a folder that cannot be read or written costs only time.
    """
    if (code := stored(key)) is None:
        store(key, code := make())
    return code


def cached_by_sources(request: str, make: Callable[[], bytes], folders: Sequence[Path]) -> bytes:
    """Return `make()`, or the stored result for the same `request` from the same sources and library versions.

    `folders` hold the sources. If one has changed since this process began, call `make`: which version this process
    imported is unknown.
    """
    key = key_by_sources(request, folders)
    return make() if key is None else cached(key, make)


def key_by_sources(request: str, folders: Sequence[Path]) -> str | None:
    """Return the key of `request`, these sources and library versions; None if a source has changed since the start."""
    digests, changes = zip(*map(_sources, folders), strict=True)
    if max(changes) >= BEGAN:
        return None
    x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    versions = [sys.version, jax.__version__, np.__version__, llvmlite.__version__]
    return "\n".join([*digests, *versions, binding.get_default_triple(), str(x64), request])


def cache_is_on() -> bool:
    """Return whether there is a folder to keep code in."""
    return bool(_folder())


def stored(key: str) -> bytes | None:
    """Return what `store` kept for a key, or None."""
    if not (folder := _folder()):
        return None
    with suppress(OSError):
        found = _file(folder, key).read_bytes()
        if hashlib.sha256(found[DIGEST:]).digest() == found[:DIGEST]:
            return found[DIGEST:]
    return None


def store(key: str, code: bytes) -> None:
    """Keep code for a key, whole or not at all, if there is a folder."""
    if not (folder := _folder()):
        return
    file = _file(folder, key)
    unfinished = file.with_name(f".{file.name}.{os.getpid()}.{threading.get_ident()}")
    with suppress(OSError):
        try:
            unfinished.write_bytes(hashlib.sha256(code).digest() + code)
            unfinished.replace(file)
        finally:
            unfinished.unlink(missing_ok=True)  # a full disk must not stay full because of it


def _folder() -> str | None:
    on = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    return jax.config.jax_compilation_cache_dir if on else None  # pyright: ignore[reportAttributeAccessIssue]


def _file(folder: str, key: str) -> Path:
    return Path(folder) / f"levelproof-{hashlib.sha256(key.encode()).hexdigest()}.kernel"


@cache
def _sources(folder: Path) -> tuple[str, float]:
    """Return a hash of a folder's sources, names and bytes, and when the last of them changed."""
    digest, changed = hashlib.sha256(), 0.0
    for path in sorted(folder.rglob("*.py")):
        about = path.stat()
        digest.update(f"{path.relative_to(folder)} {about.st_size}\n".encode() + path.read_bytes())
        changed = max(changed, about.st_mtime, about.st_ctime)  # a copy may keep its original's mtime
    return digest.hexdigest(), changed
