"""Files of a split in an object store, written: each at once or not at all, and some only if nobody else was first.

Any request may be made again, also one that was done and whose answer was lost: so whoever is told that somebody else
was first looks whether it was itself. Knows nothing of what is in the files.
"""

from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from levelproof.pipeline.errors import StoreFailure, UserError
from levelproof.pipeline.store.remote import as_typed, ask, data_of, obstore_module, place
from levelproof.pipeline.urls import BUCKETS

PART = 2**25  # bytes; larger files are sent in parts


class Version(NamedTuple):
    """Which bytes a file has: what a store is told that is to change these and no others."""

    e_tag: str | None
    version: str | None

    @staticmethod
    def of(about: Any) -> "Version":
        return Version(about.get("e_tag"), about.get("version"))

    @property
    def mode(self) -> dict[str, str]:
        return {name: value for name, value in self._asdict().items() if value}


class StoredFile(NamedTuple):
    """A file as it is now."""

    data: bytes
    version: Version


def get(path: Path, most: float = inf) -> StoredFile:
    """A file as the store has it now, past any cache.

    Raises:
        FileNotFoundError: it is not there.
        OSError: it has more than `most` bytes.
        UserError: there is no such bucket, or we may not.
        StoreFailure: the store does not answer.
    """
    store, key = place(path)

    def request() -> StoredFile:
        answer = obstore_module().get(store, key)
        return StoredFile(data_of(answer, most), Version.of(answer.meta))

    found = ask(path, request)
    if len(found.data) > most:
        raise OSError(f"{as_typed(path)} is larger than it can be")
    return found


def begin_of(path: Path, most: int) -> tuple[bytes, int]:
    """The first bytes of a file, at most so many, and the size of the whole, past any cache. Raises as `get`."""
    store, key = place(path)

    def request() -> tuple[bytes, int]:
        answer = obstore_module().get(store, key, options={"range": (0, most)})
        return data_of(answer, most), answer.meta["size"]

    return ask(path, request)


def put(path: Path, data: bytes | Path) -> None:
    """A file, or the bytes of one on this machine, whatever was there before. Raises as `get`."""
    store, key = place(path)
    ask(path, lambda: obstore_module().put(store, key, data, chunk_size=PART), "write")


def put_if(path: Path, data: bytes, there: Version | None) -> Version | None:
    """A file, if the bytes that are there are still those (None: if nothing is there).

    Returns:
        Its version now; None: others were first, and nothing has changed.

    Raises: as `get`.
    """
    (store, key), obstore = place(path), obstore_module()
    refusals = (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError)

    def request() -> Version | None:
        try:
            return Version.of(obstore.put(store, key, data, mode=there.mode if there else "create"))
        except refusals:
            return None

    try:
        if made := ask(path, request, "write"):
            return made
        now = get(path)
    except FileNotFoundError:
        return None
    return now.version if now.data == data else None


def remove(paths: Iterable[Path]) -> None:
    """These files of one store, as far as they are there. Raises as `get`."""
    if places := [(path, *place(path)) for path in paths]:
        first, store, _ = places[0]
        try:
            ask(first, lambda: obstore_module().delete(store, [key for _, _, key in places]), "write")
        except FileNotFoundError:  # of one of them: Google's and Microsoft's stores say so, and others may be left
            for path, _, key in places:
                with suppress(FileNotFoundError):
                    ask(path, partial(obstore_module().delete, store, key), "write")


def require_conditions(probe: Path) -> None:
    """Prove that files can be written to a store, and that it heeds conditions; `probe` is a file for this alone.

    Raises:
        UserError: they cannot, or it does not.
        StoreFailure: it does not answer.
    """
    if probe.parts[0] not in BUCKETS:
        raise UserError(f"Nothing can be written to {as_typed(probe.parent)}: give a folder, or a URL of s3, gs or az.")
    try:
        first = put_if(probe, b"1", None)
        heeded = first is not None and put_if(probe, b"2", None) is None
        heeded = heeded and put_if(probe, b"3", first) is not None and put_if(probe, b"4", first) is None
        remove([probe])
    except (NotImplementedError, obstore_module().exceptions.NotSupportedError):
        heeded = False
    except StoreFailure as failure:
        if "(501" not in str(failure):  # in its URL there may be any number
            raise
        heeded = False
    if not heeded:
        raise UserError(
            f"The store of {as_typed(probe.parent)} does not heed the conditions (If-None-Match, If-Match) that keep "
            "writers apart: make the split in a folder, and copy it there."
        )
