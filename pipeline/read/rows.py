"""What shards hold of some rows of a manifest, side by side, whatever shards they lie in."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.remote import at_once
from levelproof.pipeline.store.shard import Shard, open_shard, read_together

COLUMNS = ("level_id", "size", "shard", "row")  # that rows need to be read

Open = Callable[[Path, str, str], Shard]


def read_rows(split: Path, rows: pa.Table, fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Named arrays of these rows, in their order: level axis last and, for `record/` fields, time first.

    Where a shard is gone because a seal has put its levels elsewhere, the manifest is asked again.

    Args:
        split: that the rows are of.
        rows: of its manifest, at least one, all with a witness; at least COLUMNS.
        fields: names to return (default: all).

    Raises:
        Failure: a shard is missing or damaged, or has other levels than the manifest says.
    """
    wanted = None if fields is None else list(fields)
    while True:
        try:
            arrays = read_placed(split, rows, wanted)
            return {name: np.ascontiguousarray(np.moveaxis(x, 0, -1)) for name, x in arrays.items()}
        except Failure:
            moved = moved_rows(split, rows)
            if same_places(rows, moved):
                raise
            rows = moved


def read_row(split: Path, row: Mapping[str, Any], fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The same of one row, a mapping with COLUMNS."""
    return read_rows(split, pa.Table.from_pylist([{name: row[name] for name in COLUMNS}]), fields)


def moved_rows(split: Path, rows: pa.Table) -> pa.Table:
    """The same levels as the manifest has them now, in their order.

    Raises:
        Failure: it has not all of them any more.
    """
    ids = rows.column("level_id").to_numpy()
    table = read_manifest(split, COLUMNS, ids).table
    known = table.column("level_id").to_numpy()
    if not (there := np.isin(ids, known)).all():
        raise Failure(f"The split {split} has no level {ids[~there][0]} any more: open it again.")
    return table.take(np.searchsorted(known, ids))


def same_places(one: pa.Table, other: pa.Table) -> bool:
    """Whether rows lie in the same shards; either may have dictionaries."""
    return one["shard"].cast(pa.string()).equals(other["shard"].cast(pa.string())) and one["row"].equals(other["row"])


def read_placed(
    split: Path, rows: pa.Table, fields: Iterable[str] | None = None, opened: Open = open_shard
) -> dict[str, np.ndarray]:
    """Named arrays of rows that lie where they say, level axis FIRST, then time: views of what shards hold.

    `opened` opens a shard of a split by its name and its levels' size; a cache may stand in for it.

    Raises:
        Failure: as `read_rows`.
    """
    ids, sizes, names, row = (rows.column(name).to_pylist() for name in COLUMNS)
    by_shard: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        by_shard.setdefault(name, []).append(i)
    shards = at_once(split, lambda name, mine: opened(split, name, sizes[mine[0]]), by_shard, by_shard.values())
    parts = [(shard, [row[i] for i in mine]) for shard, mine in zip(shards, by_shard.values(), strict=True)]
    for (shard, held), mine in zip(parts, by_shard.values(), strict=True):
        known = [shard.level_ids[k] if 0 <= k < len(shard.level_ids) else None for k in held]
        if known != [ids[i] for i in mine]:
            raise Failure(f"The shard {shard.path} has not the levels that the manifest says: verify {split}.")
    return read_together(parts, fields, places=[*by_shard.values()])
