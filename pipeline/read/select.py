"""Selection of manifest rows by an SQL condition, evaluated by DuckDB."""

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.manifest import Manifest, require_manifest

SOLVED = "label = 'solved'"  # default condition of exports
EXPORT_COLUMNS = ("level_id", "size", "budget", "shard", "row")
TABLE = "manifest"  # name of the manifest in SQL
WILDCARDS = {TABLE, "columns"}  # words that may refer to every column in DuckDB, as in COLUMNS(*)


def columns_in(where: str | None) -> list[str]:
    """Return the columns that a condition may refer to: those whose names are among its words."""
    words = set(re.findall(r"\w+", (where or "").lower()))
    return [name for name in COLUMNS.names if name in words or words & WILDCARDS]


def select(table: pa.Table, where: str | None) -> pa.Table:
    """Return the manifest rows that meet the SQL condition (None: all), sorted by level id.

    Args:
        table: manifest rows sorted by level id, with at least the columns of the condition (`columns_in`).
        where: the condition.

    Raises:
        UserError: the condition is invalid.
    """
    if where is None:
        return table
    advice = f"it is SQL over the columns {', '.join(COLUMNS.names)}"
    chosen = ids_by(table, f"WHERE ({where}\n)", f"use the condition {where!r}", advice)
    return table.filter(np.isin(table.column("level_id").to_numpy(), chosen))


def ids_by(table: pa.Table, clause: str, what: str, advice: str) -> np.ndarray:
    """Return the level ids of manifest rows that the clause, part of an SQL query, selects or sorts.

    Raises:
        UserError: DuckDB rejects the clause; the sentence is made of `what` cannot be done, and the `advice`.
    """
    with duckdb.connect() as connection:
        connection.register(TABLE, table)
        connection.execute("SET enable_external_access = false")  # clauses must not read files
        try:
            return connection.sql(f"SELECT level_id FROM {TABLE} {clause}").fetchnumpy()["level_id"]
        except duckdb.Error as error:
            reason = str(error).strip().splitlines()[0]
            raise UserError(f"Cannot {what} ({reason}): {advice}.") from None


def require_selected(split: Path, columns: Sequence[str], where: str | None, count: int | None = None) -> Manifest:
    """Read these columns of the levels that meet the condition (None: all), of the first `count` (None: all).

    The columns of the condition are read first, because hashes and contents of seeds take time: none is made for a
    level that is not selected.

    Raises:
        UserError: there is no such split, or the condition is invalid.
        Failure: a fragment is damaged.
    """
    chosen = select(require_manifest(split, ["level_id", *columns_in(where)]).table, where)["level_id"].to_numpy()
    return require_manifest(split, columns, chosen[:count])


def both(where: str | None, condition: str) -> str:
    """Return the condition that both `where`, which may be empty, and `condition` hold."""
    return f"({where}) AND {condition}" if where else condition


def labelled(rows: pa.Table, labels: Collection[str]) -> Bool[np.ndarray, " row"]:
    """Return which rows of a manifest have one of the labels; `rows` has the column `label`."""
    names = pa.array(labels, pa.string())
    return pc.is_in(rows["label"].cast(pa.string()), names).to_numpy().copy()  # pyright: ignore[reportAttributeAccessIssue]


def select_some(split: Path, table: pa.Table, where: str | None) -> pa.Table:
    """Return the rows that `select` returns. Raise UserError if there are none, or as `select` does."""
    rows = select(table, where)
    if not rows.num_rows:
        raise UserError(f"No level of {split} meets the condition {where}: choose another one with --where.")
    return rows


def select_witnessed(split: Path, where: str) -> pa.Table:
    """Return the rows (EXPORT_COLUMNS) of levels that have a witness and meet the condition, sorted by level id.

    Raises:
        UserError: no level qualifies, or the condition is invalid.
        Failure: a fragment is damaged.
    """
    rows = select(require_manifest(split, [*columns_in(where), *EXPORT_COLUMNS]).table, where)
    rows = rows.filter(rows.column("shard").is_valid())
    if not rows.num_rows:
        raise UserError(f"No level of {split} for which {where} holds has a witness: choose others with --where.")
    return rows
