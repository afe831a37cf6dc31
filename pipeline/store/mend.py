"""What is damaged taken out of a split, and nothing that is sound: the rows that are lost leave their fragments.

Each fragment is written again in one step, or removed where it has no sound row. What no row names afterwards goes
with the next cleaning. A process that dies in between leaves a split of which less is taken out: where a fragment has
another name than before, the one that it takes the place of counts until it is gone, for it has more rows.
"""

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.layout import data_path, data_paths, made_within, new_attempt, unit_name
from levelproof.pipeline.store.leftovers import disown
from levelproof.pipeline.store.manifest import (
    DATA_COLUMNS,
    begin_fragment,
    data_named_by,
    fragment_paths,
    named_by,
    read_fragment,
    with_places,
    write_fragment,
)
from levelproof.pipeline.store.merge import Place, merge_shards


def take_out(split: Path, lost: Collection[int], unlike: Collection[str], damaged: Collection[Path]) -> None:
    """Take out these levels, and these fragments whole. Only who has the split locked may, while nobody commits.

    Args:
        split: with its fragments.
        lost: levels whose rows go.
        unlike: shards and experts of which files are damaged; levels that are not lost are copied to other shards.
        damaged: fragments of which nothing is to be believed.

    Raises:
        Failure: another fragment is damaged by now, or a level that is not lost cannot be copied.
        OSError: the disk refuses.
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
    # The name that its rows give it: its old one may be that of the unit in which lost levels are made again
    unit = unit_name(ids[0], ids[-1]) if ids else path.stem
    attempts = [new_attempt(split, unit) for _ in stale or [path]]
    for attempt in attempts if ids else ():
        begin_fragment(attempt)
    for name, attempt in zip(sorted(stale), attempts, strict=False):
        rows = _moved(split, rows, name, attempt.shard)
    theirs = {path, attempts[-1].fragment} & {*fragment_paths(split)}  # two: somebody died between the two below
    named = {name for of in theirs for name in data_named_by(read_fragment(of, DATA_COLUMNS)[1])}
    _disown_named(split, named - data_named_by(rows))
    if ids:
        settings = fragment.config_hash, fragment.config
        write_fragment(attempts[-1], rows, *settings, fragment.sealed, fragment.densities, fragment.digests)
    if not ids or attempts[-1].fragment != path:
        path.unlink()


def _disown_named(split: Path, names: Collection[str]) -> None:
    for name in names:
        with suppress(Failure):  # of a name that leads elsewhere: what is there is not ours
            disown([data_path(split, name)])


def _moved(split: Path, rows: pa.Table, old: str, new: Path) -> pa.Table:
    """The rows, of which those of one shard have been copied to a new one, one after another."""
    names, places, ids = (rows.column(name).to_pylist() for name in ("shard", "row", "level_id"))
    moving = [i for i, name in enumerate(names) if name == old]
    merge_shards(new, [Place(data_path(split, old), places[i], ids[i]) for i in moving])
    for row, i in enumerate(moving):
        names[i], places[i] = new.relative_to(split).as_posix(), row
    return with_places(rows, names, places)
