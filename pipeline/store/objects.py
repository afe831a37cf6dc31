"""Writing files of a split to an object store: each whole or not at all, some only if no other process was first.

Any request may be repeated, even one that succeeded but whose response was lost. So a process whose precondition fails
checks whether its own earlier request was the first. Knows nothing of the files' contents.
"""

from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from levelproof.pipeline.errors import StoreFailure, UserError
from levelproof.pipeline.store.remote import place
from levelproof.pipeline.store.requests import MUCH, SENDING_MUCH, Turns, ask, data_of, obstore_module
from levelproof.pipeline.urls import BUCKETS, as_typed

PART = 2**23  # bytes; larger files are sent in parts, one after another


class Version(NamedTuple):
    """Identity of a file's bytes, for conditional writes that replace these bytes and no others."""

    e_tag: str | None
    version: str | None

    @staticmethod
    def of(about: Any) -> "Version":
        return Version(about.get("e_tag"), about.get("version"))

    @property
    def mode(self) -> dict[str, str]:
        return {name: value for name, value in self._asdict().items() if value}


class StoredFile(NamedTuple):
    """A file as the store has it now."""

    data: bytes
    version: Version


def get(path: Path, most: float = inf) -> StoredFile:
    """Read a file from the store, past any cache.

    Raises:
        FileNotFoundError: it does not exist.
        OSError: it has more than `most` bytes.
        UserError: there is no such bucket, or access is denied.
        StoreFailure: the store does not answer.
    """
    store, key = place(path)

    def request() -> StoredFile:
        response = obstore_module().get(store, key)
        return StoredFile(data_of(response, most), Version.of(response.meta))

    file = ask(path, request)
    if len(file.data) > most:
        raise OSError(f"{as_typed(path)} is larger than {most} bytes")
    return file


def begin_of(path: Path, most: int) -> tuple[bytes, int]:
    """Read at most the first `most` bytes of a file, and its size, past any cache. Raises as `get`."""
    store, key = place(path)

    def request() -> tuple[bytes, int]:
        response = obstore_module().get(store, key, options={"range": (0, most)})
        return data_of(response, most), response.meta["size"]

    return ask(path, request)


def put(path: Path, data: bytes | Path) -> None:
    """Write bytes, or a file of this machine, to `path`, replacing any file there. Raises as `get`."""
    size = data.stat().st_size if isinstance(data, Path) else len(data)
    store, key = place(path, size)
    send = lambda: obstore_module().put(store, key, data, chunk_size=PART, max_concurrency=1)
    ask(path, send, "write", _turns(size))


def _turns(size: int) -> Turns | None:
    """Return what a request that sends this many bytes waits for."""
    return SENDING_MUCH if size > MUCH else None


def put_if(path: Path, data: bytes, there: Version | None) -> Version | None:
    """Write a file if the store still has the version `there` (None: if it has no such file).

    Returns:
        The new version; None: another process was first, and nothing has changed.

    Raises: as `get`.
    """
    (store, key), obstore = place(path, len(data)), obstore_module()
    refusals = (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError)

    def request() -> Version | None:
        try:
            return Version.of(obstore.put(store, key, data, mode=there.mode if there else "create"))
        except refusals:
            return None

    try:
        if made := ask(path, request, "write", _turns(len(data))):
            return made
        now = get(path)
    except FileNotFoundError:
        return None
    return now.version if now.data == data else None


def remove(paths: Iterable[Path]) -> None:
    """Delete these files of one store, if they exist. Raises as `get`."""
    if located := [(path, *place(path)) for path in paths]:
        first, store, _ = located[0]
        try:
            ask(first, lambda: obstore_module().delete(store, [key for _, _, key in located]), "write")
        except FileNotFoundError:  # Google's and Microsoft's stores stop at a missing file and may leave others
            for path, _, key in located:
                with suppress(FileNotFoundError):
                    ask(path, partial(obstore_module().delete, store, key), "write")


def _has_conditions(probe: Path) -> bool:
    """Whether conditional writes of `probe` succeed and fail as they should."""
    first = put_if(probe, b"1", None)
    supported = first is not None and put_if(probe, b"2", None) is None
    supported = supported and put_if(probe, b"3", first) is not None and put_if(probe, b"4", first) is None
    remove([probe])
    return supported


def require_conditions(probe: Path) -> None:
    """Check that a store is writable and supports preconditions, by writing the unused file `probe`.

    Raises:
        UserError: it is read-only, or does not support them.
        StoreFailure: it does not answer.
    """
    if probe.parts[0] not in BUCKETS:
        raise UserError(f"Nothing can be written to {as_typed(probe.parent)}: give a folder, or a URL of s3, gs or az.")
    try:
        supported = any(_has_conditions(probe) for _ in range(3))  # a writer that cleans the split may remove the probe
    except (NotImplementedError, obstore_module().exceptions.NotSupportedError):
        supported = False
    except StoreFailure as failure:
        if "(501" not in str(failure):  # with the bracket, because the URL may contain any number
            raise
        supported = False
    if not supported:
        raise UserError(
            f"The store of {as_typed(probe.parent)} does not support the preconditions (If-None-Match, If-Match) that "
            "exclude a second writer: write the split to a folder, and copy it there."
        )
