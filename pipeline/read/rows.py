"""Arrays of manifest rows, gathered from whatever shards hold them."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.store.remote import at_once
from levelproof.pipeline.store.shard import Part, Report, Shard, read_together, warn_unlike
from levelproof.pipeline.urls import quoted

COLUMNS = ("level_id", "size", "shard", "row")  # required of rows

Open = Callable[[Path, str, str], Shard]


def read_rows(
    split: Path, rows: pa.Table, fields: Iterable[str] | None = None, report: Report = warn_unlike
) -> dict[str, np.ndarray]:
    """Read arrays of these rows by field name, in row order: level axis last; time first in `record/` fields.

    If a seal has moved levels to another shard, rereads the manifest and retries.

    Args:
        split: path or URL of the split.
        rows: manifest rows with at least COLUMNS; at least one row, all with a witness.
        fields: names of the fields to return; None: all.
        report: called if states differ on this machine from the stored ones.

    Raises:
        Failure: a shard is missing or damaged, or its levels differ from the manifest; or as `report`.
    """
    wanted = None if fields is None else list(fields)
    while True:
        try:
            arrays = gather_rows(split, rows, wanted, report=report)
            return {name: np.ascontiguousarray(np.moveaxis(x, 0, -1)) for name, x in arrays.items()}
        except Failure:
            current = current_rows(split, rows)
            if same_positions(rows, current):
                raise
            rows = current


def read_row(split: Path, row: Mapping[str, Any], fields: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of one row, a mapping with COLUMNS, as `read_rows`; the level axis has length 1."""
    return read_rows(split, pa.Table.from_pylist([{name: row[name] for name in COLUMNS}]), fields)


def current_rows(split: Path, rows: pa.Table) -> pa.Table:
    """Reread the manifest rows (COLUMNS) of the levels of `rows`, in the same order.

    Raises:
        Failure: the manifest no longer has some of the levels.
    """
    ids = rows.column("level_id").to_numpy()
    table = read_manifest(split, COLUMNS, ids).table
    known = table.column("level_id").to_numpy()
    if not (present := np.isin(ids, known)).all():
        raise Failure(f"The split {split} no longer has level {ids[~present][0]}: open it again.")
    return table.take(np.searchsorted(known, ids))


def same_positions(left: pa.Table, right: pa.Table) -> bool:
    """Whether two tables name the same shards and rows; either may be dictionary-encoded."""
    return left["shard"].cast(pa.string()).equals(right["shard"].cast(pa.string())) and left["row"].equals(right["row"])


def gather_rows(
    split: Path,
    rows: pa.Table,
    fields: Iterable[str] | None = None,
    opened: Open = open_shard,
    report: Report = warn_unlike,
) -> dict[str, np.ndarray]:
    """Gather arrays by field name from the shards that the rows name: level axis FIRST, then time; may be views.

    Unlike `read_rows`, does not follow levels that a seal has moved.

    Args:
        split: path or URL of the split.
        rows: as `read_rows`.
        fields: as `read_rows`.
        opened: opens a shard, given the split, the shard's name and the size of its levels; a cache may replace it.
        report: called if states differ on this machine from the stored ones.

    Raises:
        Failure: a shard is missing or damaged, or its levels differ from the manifest; or as `report`.
    """
    parts, places = parts_of(split, rows, opened)
    return read_together(parts, fields, report, places)


def parts_of(split: Path, rows: pa.Table, opened: Open = open_shard) -> tuple[list[Part], list[list[int]]]:
    """Open the shards that rows name; return the rows of each, and their positions among `rows`.

    Raises:
        Failure: as `gather_rows`.
    """
    ids, sizes, names, row = (rows.column(name).to_pylist() for name in COLUMNS)
    by_shard: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        by_shard.setdefault(name, []).append(i)
    shards = at_once(split, lambda name, mine: opened(split, name, sizes[mine[0]]), by_shard, by_shard.values())
    parts: list[Part] = [(shard, [row[i] for i in mine]) for shard, mine in zip(shards, by_shard.values(), strict=True)]
    for (shard, held), mine in zip(parts, by_shard.values(), strict=True):
        known = [shard.level_ids[k] if 0 <= k < len(shard.level_ids) else None for k in held]
        if known != [ids[i] for i in mine]:
            raise Failure(
                f"The shard {shard.path} does not have the levels that the manifest lists: "
                f"run `levelproof verify {quoted(split)}`."
            )
    return parts, [*by_shard.values()]
