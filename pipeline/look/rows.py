"""Rows of a manifest that somebody asks for: which, in which order, with which columns; on the screen or as CSV."""

import csv
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import duckdb
import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.select import TABLE, columns_in, select
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.manifest import require_manifest

BLOCK = 2**14  # rows that are read at once
SHOWN = ("level_id", "label", "success_rate", "steps_to_goal", "steps_to_first_success", "env_steps")


class Asked(NamedTuple):
    """What somebody wants to see of a manifest."""

    where: str | None = None  # an SQL condition
    columns: Sequence[str] | None = None  # by name; None: SHOWN on the screen, all elsewhere
    sort: str | None = None  # an SQL expression, DESC or not; null comes last; None: by level id
    limit: int | None = None  # rows; None: a screen's, and all of a CSV

    def check(self) -> None:
        """Raises UserError where a column is none."""
        for name in self.columns or ():
            if name not in COLUMNS.names:
                raise UserError(f"There is no column {name!r}: choose of {', '.join(COLUMNS.names)}.")


EVERYTHING = Asked()


def ids_of(table: pa.Table, asked: Asked) -> np.ndarray:
    """The ids of the rows that are wanted, in their order, of those that fit; with the columns of `asked.sort`.

    Raises:
        UserError: DuckDB cannot order by that.
    """
    ids = table.column("level_id").to_numpy()
    if asked.sort is not None:
        with duckdb.connect() as connection:
            connection.register(TABLE, table)
            connection.execute("SET enable_external_access = false")
            try:
                query = f"SELECT level_id FROM {TABLE} ORDER BY {asked.sort}\n NULLS LAST, level_id"
                ids = connection.sql(query).fetchnumpy()["level_id"]
            except duckdb.Error as error:
                reason = str(error).strip().splitlines()[0]
                raise UserError(
                    f"Cannot sort by {asked.sort!r} ({reason}): give a column, or such as 'steps_to_goal DESC'."
                ) from None
    return ids if asked.limit is None else ids[: max(asked.limit, 0)]


def rows_of(split: Path, ids: np.ndarray, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
    """These rows in this order, a block at a time."""
    for first in range(0, len(ids), BLOCK):
        wanted = ids[first : first + BLOCK]
        table = require_manifest(split, columns, np.sort(wanted)).table
        here = np.searchsorted(table.column("level_id").to_numpy(), wanted)
        yield table.take(here).select(columns or table.column_names)


def write_csv(split: Path, asked: Asked, to: IO[str]) -> None:
    """The rows as CSV with a line of names; lists and records as JSON, what does not exist as nothing.

    Raises:
        UserError: no split, a column that is none, or a condition or an order that DuckDB cannot use.
        Failure: a fragment is damaged.
    """
    asked.check()
    table = select(
        require_manifest(split, [*columns_in(asked.where), *columns_in(asked.sort)], compact=True).table, asked.where
    )
    names, writer = list(asked.columns or COLUMNS.names), csv.writer(to, lineterminator="\n")
    writer.writerow(names)
    for block in rows_of(split, ids_of(table, asked), names):
        writer.writerows([_cell(value) for value in row.values()] for row in block.to_pylist())


def _cell(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, list | dict) else value
