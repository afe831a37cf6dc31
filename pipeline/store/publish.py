"""Attempts at units of a split in an object store: made in a folder here, then carried over, the fragment last.

An attempt (1) puts its mark, (2) looks what is at its fragment's place: nothing or a fence, a fragment without rows,
(3) looks whether the writer for whom it works still has the lease, (4) puts its data, and (5) its fragment, if nothing
else is at that place by now than in (2). A writer that has taken the lease looks for marks, and puts a new fence where
a unit with a mark is not committed. So an attempt for an earlier writer is not committed after that: either its mark
was seen, and it finds another fence than in (2); or the mark came later, and it finds another lease in (3).
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

OVER = b"over"  # in the mark of an attempt that was committed, and is no more: others have its levels


@contextmanager
def publishing(split: Path, replaced: Collection[Path] = ()) -> Iterator[Path]:
    """A folder for one attempt, which is carried over when this block ends well.

    Another attempt at the unit may be committed first: if it has the same levels, this one goes. But where fragments
    are to be `replaced`, the new one may take the place of one of them, and of no other.

    Raises:
        LeaseLost: another writer has the split now; nothing is committed.
        Failure: another attempt was committed first, without some of the levels.
        UserError, StoreFailure: the store refuses.
    """
    with scratch() as folder:
        yield folder
        _carry_over(folder, split, replaced)


def _carry_over(folder: Path, split: Path, replaced: Collection[Path]) -> None:
    (fragment,) = fragment_paths(folder)
    theirs = split / fragment.relative_to(folder)
    data = [split / path.relative_to(folder) for path in data_paths(folder)]
    marks = list(dict.fromkeys(map(begun_path, data))) or [new_attempt(split, fragment.stem).begun]
    for mark in marks:
        put(mark, b"")
    there = _at(theirs)
    if not there.ids or theirs in replaced:
        require_served(split)
        files = [path for path in folder.rglob("*/*") if path.is_file() and path != fragment]
        at_once(split, put, [split / path.relative_to(folder) for path in files], files)
        if put_if(theirs, fragment.read_bytes(), there.version):
            remove(marks)
            return
        there = _at(theirs)
    for path in data:
        remove_data(path)
    remove(marks)
    if not there.ids or replaced:
        raise LeaseLost(split)
    if not _ids(fragment.read_bytes()) <= there.ids:
        raise Failure(f"Another attempt was committed meanwhile as {theirs}, without some of the levels of this one.")


def committed_levels(split: Path, unit: str) -> frozenset[int]:
    """Levels that the fragment of a unit has by now, of an attempt of which nobody has heard.

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
    """The marks of attempts that are not committed any more, whatever they do; `committed` are fragments that count.

    Raises:
        UserError, StoreFailure: the store refuses.
    """
    about = fragments_in(split / MANIFEST)
    over, by_fragment = {mark for mark in marks if mark in about and about[mark].size}, dict[Path, set[Path]]()
    for mark in set(marks) - over:
        by_fragment.setdefault(fragment_path(split, attempt_of(mark).rpartition("-")[0]), set()).add(mark)
    barred = at_once(split, lambda fragment: fragment in committed or _barred(fragment), by_fragment)
    return over.union(*(of for of, bar in zip(by_fragment.values(), barred, strict=True) if bar))


def _barred(fragment: Path) -> bool:
    """Whether a fence could be put; it cannot where somebody else was first."""
    there = _at(fragment)
    return not there.ids and put_if(fragment, _fence(), there.version) is not None


class _There(NamedTuple):
    """What is at a fragment's place."""

    ids: frozenset[int]  # of a fence or of nothing: none
    version: Version | None


def _at(fragment: Path) -> _There:
    try:
        found = get(fragment)
    except FileNotFoundError:
        return _There(frozenset(), None)
    try:
        return _There(_ids(found.data), found.version)
    except DAMAGE:
        raise Failure(f"The fragment {fragment} is damaged: remove it, and run the same command again.") from None


def _ids(data: bytes) -> frozenset[int]:
    return frozenset(pq.read_table(pa.BufferReader(data), columns=["level_id"])["level_id"].to_pylist())


def _fence() -> bytes:
    """A fragment without rows, other bytes each time."""
    nobody = {"fence": secrets.token_hex(8)}
    with scratch() as folder:
        attempt = new_attempt(folder, unit_name(0, 0))
        begin_fragment(attempt)
        write_fragment(attempt, [], hash_of(nobody), nobody)
        return attempt.fragment.read_bytes()
