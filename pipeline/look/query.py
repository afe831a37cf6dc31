"""Queries on a manifest: which rows, in which order, with which columns; as tables or as CSV."""

import csv
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import pyarrow as pa
from rich.console import Console

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.outlet import has_reader
from levelproof.pipeline.read.levels import with_known_costs
from levelproof.pipeline.read.select import columns_in, ids_by, select
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.progress_bar import ProgressBar
from levelproof.pipeline.store.seed.file import is_seed

BLOCK = 2**14  # rows read at a time
SHOWN = ("level_id", "label", "success_rate", "steps_to_goal", "steps_to_first_success", "env_steps")


class RowQuery(NamedTuple):
    """Selection of a manifest's rows and columns."""

    where: str | None = None  # an SQL condition
    columns: Sequence[str] | None = None  # names; None: SHOWN on the screen, all elsewhere
    sort: str | None = None  # SQL expression, may end in DESC; null comes last; None: by level id
    limit: int | None = None  # number of rows; None: 10 on the screen, all in CSV

    def check(self) -> None:
        """Raise UserError if a column does not exist."""
        for name in self.columns or ():
            if name not in COLUMNS.names:
                raise UserError(f"There is no column {name!r}: choose from {', '.join(COLUMNS.names)}.")


ALL_ROWS = RowQuery()


def ids_of(table: pa.Table, query: RowQuery) -> np.ndarray:
    """Sort and limit the level ids of `table`, which has the columns of `query.sort`.

    Raises:
        UserError: DuckDB cannot sort by that expression.
    """
    ids = table.column("level_id").to_numpy()
    if query.sort is not None:
        clause = f"ORDER BY {query.sort}\n NULLS LAST, level_id"
        ids = ids_by(table, clause, f"sort by {query.sort!r}", "give a column, or one such as 'steps_to_goal DESC'")
    return ids if query.limit is None else ids[: query.limit]


def rows_of(split: Path, ids: np.ndarray, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
    """Read the rows of these ids in this order, a block at a time."""
    for first in range(0, len(ids), BLOCK):
        wanted = ids[first : first + BLOCK]
        table = with_known_costs(require_manifest(split, columns, np.sort(wanted)))
        here = np.searchsorted(table.column("level_id").to_numpy(), wanted)
        yield table.take(here).select(columns or table.column_names)


def prepare_for_seeds(*splits: Path) -> None:
    """Set JAX up if a split is of seeds, whose levels are made anew where a query asks for their hashes."""
    if any(map(is_seed, splits)):
        prepare_jax()


def write_csv(split: Path, query: RowQuery, out: IO[str]) -> None:
    """Write the rows as CSV under a header; lists and structs are JSON, null is empty.

    Raises:
        UserError: no split, an unknown column, or DuckDB rejects the condition or the order.
        Failure: a fragment is damaged.
    """
    query.check()
    prepare_for_seeds(split)
    table = select(
        require_manifest(split, [*columns_in(query.where), *columns_in(query.sort)], compact=True).table, query.where
    )
    names, writer = list(query.columns or COLUMNS.names), csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    ids = ids_of(table, query)
    with ProgressBar("rows", len(ids), None if out.isatty() else Console(stderr=True)) as bar:
        for block in rows_of(split, ids, names):
            writer.writerows([_cell(value) for value in row.values()] for row in block.to_pylist())
            bar.advance(block.num_rows)
            if not has_reader():
                return


def _cell(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, list | dict) else value
