"""Attempts at units of a split in an object store: written to a local folder, then uploaded, the fragment last.

An attempt (1) writes its mark, (2) reads its fragment's path, where it expects no file or a fence (a fragment without
rows), (3) checks that its writer still has the lease, (4) writes its data, and (5) writes its fragment, if the path
still has what (2) found. A writer that has taken the lease lists marks, and writes a new fence for each unit with a
mark but no commit. So no attempt of an earlier writer can commit after that: either its mark was listed, and (5) finds
a new fence; or the mark came later, and (3) finds another lease.
"""

import secrets
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from levelproof.configs.schema import hash_of
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.bounds import DAMAGE
from levelproof.pipeline.store.files import remove_data
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import (
    MANIFEST,
    attempt_of,
    begun_path,
    data_paths,
    fragment_path,
    new_attempt,
    unit_name,
)
from levelproof.pipeline.store.leases import LeaseLost, require_served
from levelproof.pipeline.store.manifest import begin_fragment, fragment_paths, write_fragment
from levelproof.pipeline.store.objects import Version, get, put, put_if, remove
from levelproof.pipeline.store.remote import at_once, fragments_in, is_remote
from levelproof.pipeline.store.scratch import scratch

OVER = b"over"  # content of the mark of data that was committed and then superseded


@contextmanager
def publishing(split: Path, replaced: Collection[Path] = ()) -> Iterator[Path]:
    """Yield a folder for one attempt, and upload it when the block ends without an exception.

    If another attempt at the unit was committed first and has all of its levels, this one is dropped. With `replaced`,
    the new fragment may overwrite one of these fragments, and no other.

    Raises:
        LeaseLost: another writer has the split now; nothing is committed.
        Failure: another attempt was committed first, without some of the levels.
        UserError, StoreFailure: the store's request fails.
    """
    with scratch() as folder:
        yield folder
        _upload(folder, split, replaced)


def _upload(folder: Path, split: Path, replaced: Collection[Path]) -> None:
    (fragment,) = fragment_paths(folder)
    theirs = split / fragment.relative_to(folder)
    data = [split / path.relative_to(folder) for path in data_paths(folder)]
    marks = list(dict.fromkeys(map(begun_path, data))) or [new_attempt(split, fragment.stem).begun]
    for mark in marks:
        put(mark, b"")
    committed = _at(theirs)
    if not committed.ids or theirs in replaced:
        require_served(split)
        files = [path for path in folder.rglob("*/*") if path.is_file() and path != fragment]
        at_once(split, put, [split / path.relative_to(folder) for path in files], files)
        if put_if(theirs, fragment.read_bytes(), committed.version):
            remove(marks)
            return
        committed = _at(theirs)
    for path in data:
        remove_data(path)
    remove(marks)
    if not committed.ids or replaced:
        raise LeaseLost(split)
    if not _ids(fragment.read_bytes()) <= committed.ids:
        raise Failure(f"Another attempt was committed first as {theirs}, without some of the levels of this one.")


def committed_levels(split: Path, unit: str) -> frozenset[int]:
    """Return the levels of a unit's fragment, which an attempt may have committed without reporting it.

    Raises:
        Failure: it is damaged.
    """
    path = fragment_path(split, unit)
    if is_remote(split):
        return _at(path).ids
    try:
        return frozenset(read_fragment(path, ["level_id"])[1].column("level_id").to_pylist())
    except FileNotFoundError:
        return frozenset()


def ended(split: Path, marks: Iterable[Path], committed: Collection[Path]) -> set[Path]:
    """Return the marks of attempts that can no longer commit; `committed` are fragments that count.

    Raises:
        UserError, StoreFailure: the store's request fails.
    """
    about = fragments_in(split / MANIFEST)
    over, by_fragment = {mark for mark in marks if mark in about and about[mark].size}, dict[Path, set[Path]]()
    for mark in set(marks) - over:
        by_fragment.setdefault(fragment_path(split, attempt_of(mark).rpartition("-")[0]), set()).add(mark)
    barred = at_once(split, lambda fragment: fragment in committed or _barred(fragment), by_fragment)
    return over.union(*(group for group, bar in zip(by_fragment.values(), barred, strict=True) if bar))


def _barred(fragment: Path) -> bool:
    """Write a fence unless the unit is committed; return whether that succeeded before any other write."""
    committed = _at(fragment)
    return not committed.ids and put_if(fragment, _fence(), committed.version) is not None


class _Committed(NamedTuple):
    """Level ids and version of the object at a fragment's path."""

    ids: frozenset[int]  # empty for a fence or a missing file
    version: Version | None


def _at(fragment: Path) -> _Committed:
    try:
        file = get(fragment)
    except FileNotFoundError:
        return _Committed(frozenset(), None)
    try:
        return _Committed(_ids(file.data), file.version)
    except DAMAGE:
        raise Failure(f"The fragment {fragment} is damaged: remove it, and run the same command again.") from None


def _ids(data: bytes) -> frozenset[int]:
    return frozenset(pq.read_table(pa.BufferReader(data), columns=["level_id"])["level_id"].to_pylist())


def _fence() -> bytes:
    """Return a fragment without rows, with different bytes each time."""
    settings = {"fence": secrets.token_hex(8)}
    with scratch() as folder:
        attempt = new_attempt(folder, unit_name(0, 0))
        begin_fragment(attempt)
        write_fragment(attempt, [], hash_of(settings), settings)
        return attempt.fragment.read_bytes()
