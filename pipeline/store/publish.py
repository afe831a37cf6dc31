"""Attempts at units of a split in an object store: written to a local folder, then uploaded, the fragment last.

An attempt (1) writes its mark, (2) reads its fragment's path, where it expects no file, a fence (a fragment without
rows) or, to seal, a fragment that it replaces, (3) checks that its writer still has the lease, (4) writes its data, and
(5) writes its fragment, if the path still has what (2) found. A writer that has taken the lease lists marks. At the
path of each whose data no fragment names, it writes a new fence, or what is committed there in other bytes. So no
attempt of an earlier writer can commit after that: either its mark was listed, and (5) finds other bytes; or the mark
came later, and (3) finds another lease.
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
from levelproof.pipeline.store.checksums import renewed
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
from levelproof.pipeline.store.manifest import (
    DATA_COLUMNS,
    begin_fragment,
    data_named_by,
    fragment_paths,
    write_fragment,
)
from levelproof.pipeline.store.objects import Version, get, put, put_if, remove
from levelproof.pipeline.store.remote import at_once, fragments_in
from levelproof.pipeline.store.scratch import scratch
from levelproof.pipeline.urls import is_remote

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
        if committed.named & {path.relative_to(split).as_posix() for path in data}:
            remove(marks)  # committed, but the answer was lost, and then another writer changed the bytes
            return
    for path in data:
        remove_data(path)
    remove(marks)
    if not committed.ids or replaced:
        raise LeaseLost(split)
    if not _ids(pq.read_table(fragment, columns=["level_id"])) <= committed.ids:
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


def ended(split: Path, marks: Iterable[Path], named: Iterable[str]) -> set[Path]:
    """Return the marks of attempts that have committed `named` data, or can no longer commit.

    Raises:
        UserError, StoreFailure: the store's request fails.
    """
    about, done = fragments_in(split / MANIFEST), {begun_path(split / name) for name in named}
    over = {mark for mark in marks if mark in done or (mark in about and about[mark].size)}
    by_fragment = dict[Path, set[Path]]()
    for mark in set(marks) - over:
        by_fragment.setdefault(fragment_path(split, attempt_of(mark).rpartition("-")[0]), set()).add(mark)
    barred = at_once(split, lambda one: _barred(split, *one), by_fragment.items())
    return over.union(*barred)


def _barred(split: Path, fragment: Path, marks: set[Path]) -> set[Path]:
    """Change the bytes at a fragment's path; return the marks of attempts that can no longer commit there.

    These are none if another write came first. Attempts whose data is named there have committed by now.
    """
    committed = _at(fragment)
    try:
        data = renewed(committed.data, secrets.token_bytes(8)) if committed.ids else _fence()
    except ValueError:
        raise _damaged(fragment) from None
    if put_if(fragment, data, committed.version) is None:
        return set()
    return marks - {begun_path(split / name) for name in committed.named}


class _Committed(NamedTuple):
    """The object at a fragment's path."""

    ids: frozenset[int] = frozenset()  # of its levels; empty for a fence or a missing file
    named: frozenset[str] = frozenset()  # its shards and experts
    version: Version | None = None
    data: bytes = b""


def _at(fragment: Path) -> _Committed:
    try:
        file = get(fragment)
    except FileNotFoundError:
        return _Committed()
    try:
        rows = pq.read_table(pa.BufferReader(file.data), columns=["level_id", *DATA_COLUMNS])
        return _Committed(_ids(rows), data_named_by(rows), file.version, file.data)
    except DAMAGE:
        raise _damaged(fragment) from None


def _damaged(fragment: Path) -> Failure:
    return Failure(f"The fragment {fragment} is damaged: remove it, and run the same command again.")


def _ids(rows: pa.Table) -> frozenset[int]:
    return frozenset(rows["level_id"].to_pylist())


def _fence() -> bytes:
    """Return a fragment without rows, with different bytes each time."""
    settings = {"fence": secrets.token_hex(8)}
    with scratch() as folder:
        attempt = new_attempt(folder, unit_name(0, 0))
        begin_fragment(attempt)
        write_fragment(attempt, [], hash_of(settings), settings)
        return attempt.fragment.read_bytes()
