"""Rows of a manifest for which an SQL condition holds, by DuckDB."""

import re
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.manifest import require_manifest

SOLVED = "label = 'solved'"  # exported where nothing else is asked for
WITNESSED = ("level_id", "size", "budget", "shard", "row")  # columns that exporters read
TABLE = "manifest"  # its name in SQL
ALL_OF_THEM = {TABLE, "columns"}  # words of conditions that can mean every column


def columns_in(where: str | None) -> list[str]:
    """The columns that a condition may ask for: those whose names are among its words."""
    words = set(re.findall(r"\w+", (where or "").lower()))
    return [name for name in COLUMNS.names if name in words or words & ALL_OF_THEM]


def select(table: pa.Table, where: str | None) -> pa.Table:
    """The manifest's rows for which the SQL condition holds, sorted by level id.

    `table` is sorted by level id, and has the columns of the condition (`columns_in`), and any others.

    Raises:
        UserError: DuckDB cannot use the condition.
    """
    if where is None:
        return table
    with duckdb.connect() as connection:
        connection.register(TABLE, table)
        connection.execute("SET enable_external_access = false")  # a condition reads the manifest, no other file
        try:
            chosen = connection.sql(f"SELECT level_id FROM {TABLE} WHERE ({where}\n)").fetchnumpy()["level_id"]
        except duckdb.Error as error:
            reason = str(error).strip().splitlines()[0]
            columns = ", ".join(COLUMNS.names)
            raise UserError(
                f"Cannot use the condition {where!r} ({reason}): it is SQL over the columns {columns}."
            ) from None
    return table.filter(np.isin(table.column("level_id").to_numpy(), chosen))


def witnessed(split: Path, where: str) -> pa.Table:
    """Rows of the levels that have a witness and for which a condition holds, by level id, with what reads them.

    Raises:
        UserError: there is none.
        Failure: a fragment is damaged.
    """
    rows = select(require_manifest(split, [*columns_in(where), *WITNESSED]).table, where)
    rows = rows.filter(rows.column("shard").is_valid())
    if not rows.num_rows:
        raise UserError(f"No level of {split} for which {where} holds has a witness: choose others with --where.")
    return rows
