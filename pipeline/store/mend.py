"""Removal of damaged rows and data from a split; everything sound stays.

Each fragment is rewritten in one step, or removed if it has no sound row. The next cleaning removes data that no row
names afterwards. If the process dies in between, less is removed: a fragment that is rewritten under a new name has
fewer rows than the old one, which takes precedence until it is removed.
"""

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import data_path, data_paths, made_within, new_attempt, unit_name
from levelproof.pipeline.store.leftovers import disown
from levelproof.pipeline.store.manifest import (
    DATA_COLUMNS,
    begin_fragment,
    data_named_by,
    fragment_paths,
    named_by,
    with_places,
    write_fragment,
)
from levelproof.pipeline.store.merge import Place, merge_shards


def take_out(split: Path, lost: Collection[int], unlike: Collection[str], damaged: Collection[Path]) -> None:
    """Remove levels, and damaged fragments whole. The caller must be the split's writer and exclude commits.

    Args:
        split: folder of the split.
        lost: levels whose rows are removed.
        unlike: shards and experts with damaged files; levels that are not lost are copied to new shards.
        damaged: fragments of which nothing is trusted.

    Raises:
        Failure: another fragment is damaged by now, or a level that is not lost cannot be copied.
        OSError: the write fails.
    """
    sound = [path for path in fragment_paths(split) if path not in damaged]
    named = {name for path in sound for name in data_named_by(read_fragment(path, DATA_COLUMNS)[1])}
    for path in damaged:
        theirs = made_within(data_paths(split), path)
        disown(data for data in theirs if data.relative_to(split).as_posix() not in named)
        path.unlink(missing_ok=True)
    for path in sound:
        _mend(split, path, np.array(sorted(lost), np.int64), frozenset(unlike))


def _mend(split: Path, path: Path, lost: np.ndarray, unlike: frozenset[str]) -> None:
    fragment, before = read_fragment(path)
    rows = before.filter(~np.isin(before.column("level_id").to_numpy(), lost))
    stale = named_by([rows], "shard") & unlike
    if rows.num_rows == before.num_rows and not stale:
        return
    ids = rows.column("level_id").to_pylist()
    # Named after its remaining rows: its old name may be that of the unit that regenerates the lost levels
    unit = unit_name(ids[0], ids[-1]) if ids else path.stem
    attempts = [new_attempt(split, unit) for _ in stale or [path]]
    for attempt in attempts if ids else ():
        begin_fragment(attempt)
    for name, attempt in zip(sorted(stale), attempts, strict=False):
        rows = _moved(split, rows, name, attempt.shard)
    theirs = {path, attempts[-1].fragment} & {*fragment_paths(split)}  # two if a process died between the writes below
    named = {name for old in theirs for name in data_named_by(read_fragment(old, DATA_COLUMNS)[1])}
    _disown_named(split, named - data_named_by(rows))
    if ids:
        settings = fragment.config_hash, fragment.config
        write_fragment(attempts[-1], rows, *settings, fragment.sealed, fragment.densities, fragment.digests)
    if not ids or attempts[-1].fragment != path:
        path.unlink()


def _disown_named(split: Path, names: Collection[str]) -> None:
    for name in names:
        with suppress(Failure):  # a path that leads elsewhere is not ours
            disown([data_path(split, name)])


def _moved(split: Path, rows: pa.Table, old: str, new: Path) -> pa.Table:
    """Copy the levels of one shard to a new one, and return all rows with their new positions."""
    names, places, ids = (rows.column(name).to_pylist() for name in ("shard", "row", "level_id"))
    moving = [i for i, name in enumerate(names) if name == old]
    merge_shards(new, [Place(data_path(split, old), places[i], ids[i]) for i in moving])
    for row, i in enumerate(moving):
        names[i], places[i] = new.relative_to(split).as_posix(), row
    return with_places(rows, names, places)
