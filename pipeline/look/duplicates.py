"""Levels that are there twice: within a split, in another split, or among level files.

By the manifest's columns `content_hash` (the same content) and `signature` (nearly the same): docs/levels.md.
DuckDB groups and joins, and each level is told with one partner only, so a split of many copies stays small to tell.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.manifest import require_manifest

COMPARED = ("content_hash", "signature")
# The few that share a half of a signature; the same content has the same signature. Grouping hashes of 8 bytes takes a
# tenth of the time and the memory that grouping strings takes.
HALVES = ("signature[1]", "signature[2]")
CONTENT = "content"  # the number of a content hash
NUMBERS = (CONTENT, *HALVES)
FACTORS = np.random.default_rng(0).integers(0, 2**63, 64, np.uint64) * 2 + 1  # of the words of a text; odd
ALIKE_WITHIN = "CREATE TABLE alike AS SELECT * FROM levels WHERE " + " OR ".join(
    f"hash({half}) IN (SELECT hash({half}) AS half FROM levels GROUP BY half HAVING count(*) > 1)" for half in HALVES
)
ALIKE_BETWEEN = "CREATE TABLE {alike} AS SELECT * FROM {levels} WHERE " + " OR ".join(
    f"hash({half}) IN (SELECT hash({half}) FROM {{others}})" for half in HALVES
)
FIRST = "SELECT min(name) AS name, first(signature) AS signature FROM alike GROUP BY content_hash"
OTHERS = "FROM alike ANTI JOIN there USING (content_hash)"
SAME = """
    SELECT name, partner FROM alike
    JOIN (SELECT content_hash, min(name) AS partner FROM {theirs} GROUP BY content_hash) USING (content_hash)
"""
NEAR = """
    WITH ours AS (SELECT name, unnest(signature) AS half, generate_subscripts(signature, 1) AS which FROM ({ours})),
    theirs AS (SELECT name, unnest(signature) AS half, generate_subscripts(signature, 1) AS which FROM ({theirs})),
    firsts AS (SELECT half, which, min(name) AS partner FROM theirs GROUP BY ALL)
    SELECT name, min(partner) AS partner FROM ours JOIN firsts USING (half, which) GROUP BY name
"""

Found = dict[str, dict[str, Any]]  # same, near -> levels (how many), pairs (the first: a level and its partner)


def compared(manifest_table: pa.Table) -> pa.Table:
    """What is compared of a manifest's rows; a level's name is its id."""
    return manifest_table.select(["level_id", *COMPARED]).rename_columns(["name", *COMPARED])


def compared_of(split: Path, level_ids: np.ndarray) -> pa.Table:
    """The same of these levels of a split."""
    return compared(require_manifest(split, COMPARED, level_ids).table)


def in_numbers(rows: pa.Table, asked: Sequence[str]) -> pa.Table:
    """Rows of a manifest with numbers in the place of what is compared, which stays where it is asked for, too."""
    half = lambda i: pc.list_element(rows["signature"], i)  # pyright: ignore[reportAttributeAccessIssue]
    numbers = {CONTENT: _numbers(rows["content_hash"])} | {name: _numbers(half(i)) for i, name in enumerate(HALVES)}
    for name, values in numbers.items():
        rows = rows.append_column(name, pa.array(values))
    return rows.drop_columns([name for name in COMPARED if name not in asked])


def perhaps_alike(levels: pa.Table) -> pa.Table:
    """What is compared, of those of these levels (`in_numbers`) that share a half of a signature.

    Two of 6 million levels have by chance one number for two contents once in a million splits.
    """
    with ThreadPoolExecutor() as threads:  # they sort, which takes the time
        shared = list(threads.map(_shared, (levels[name].to_numpy() for name in HALVES)))
    alike = levels.select(["level_id", *NUMBERS]).filter(shared[0] | shared[1])
    halves = np.stack([alike[name].to_numpy() for name in HALVES], 1)
    signature = pa.FixedSizeListArray.from_arrays(pa.array(halves.reshape(-1)), len(HALVES)).cast(pa.list_(pa.int64()))
    return pa.table({"name": alike["level_id"], "content_hash": alike[CONTENT], "signature": signature})


def _shared(values: np.ndarray) -> np.ndarray:
    """Which of them are there more than once."""
    ordered = np.sort(values)  # not `argsort`, which takes four times as long
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    found = pc.is_in(pa.array(values), pa.array(twice))  # pyright: ignore[reportAttributeAccessIssue]
    return found.to_numpy(zero_copy_only=False)


def _numbers(texts: pa.ChunkedArray) -> np.ndarray:
    """A number of 64 bits for each text, by its bytes."""
    array = pa.concat_arrays([pa.array([], pa.string()), *texts.chunks])
    widths = pc.binary_length(array).to_numpy()  # pyright: ignore[reportAttributeAccessIssue]
    numbers = np.zeros(len(array), np.uint64)
    for width in np.unique(widths).tolist():  # nearly always there is one
        mine = np.flatnonzero(widths == width)
        of_width = array if len(mine) == len(array) else array.take(pa.array(mine))
        padded = np.zeros((len(mine), -(-width // 8) * 8), np.uint8)
        padded[:, :width] = np.frombuffer(of_width.buffers()[2], np.uint8, len(mine) * width).reshape(len(mine), width)
        words = padded.view(np.uint64)
        numbers[mine] = words @ np.resize(FACTORS, words.shape[1]) + np.uint64(width)
    return numbers.view(np.int64)


def compared_in(source: Path) -> pa.Table:
    """The same of the levels of a split, of a level file, or of all level files below a folder, named by their paths.

    Raises:
        UserError: there is nothing of that kind, or a level file cannot be used.
        Failure: a fragment is damaged.
    """
    if source.is_file():
        return _of_files([source])
    if not source.is_dir() or (source / "manifest").is_dir():
        return compared(require_manifest(source, COMPARED).table)
    if not (files := sorted(source.rglob("*.json"))):
        raise UserError(f"There is neither a split nor a level file in {source}: give a folder that has one.")
    return _of_files(files)


def within(levels: pa.Table, shown: int) -> Found:
    """Levels with an earlier one of the same content; contents that an earlier one is nearly the same as."""
    with duckdb.connect() as connection:
        connection.register("levels", levels)
        connection.execute(ALIKE_WITHIN)
        queries = {"same": SAME.format(theirs="alike"), "near": NEAR.format(ours=FIRST, theirs=FIRST)}
        return {name: _pairs(connection, f"FROM ({of}) WHERE partner < name", shown) for name, of in queries.items()}


def between(levels: pa.Table, others: pa.Table, shown: int) -> Found:
    """Levels with one of the same content among the others; the rest of them with one that is nearly the same."""
    with duckdb.connect() as connection:
        connection.register("levels", levels)
        connection.register("others", others)
        connection.execute(ALIKE_BETWEEN.format(alike="alike", levels="levels", others="others"))
        connection.execute(ALIKE_BETWEEN.format(alike="there", levels="others", others="alike"))
        queries = {"same": SAME.format(theirs="there"), "near": NEAR.format(ours=OTHERS, theirs="FROM there")}
        return {name: _pairs(connection, of, shown) for name, of in queries.items()}


def told(found: Found) -> str:
    """In words: how many, and the first of them."""
    words = []
    for kind, of in found.items():
        example = " (such as {} and {})".format(*of["pairs"][0]) if of["pairs"] else ""
        words.append(f"{of['levels']:,} {kind}{example}")
    return ", ".join(words)


def _pairs(connection: duckdb.DuckDBPyConnection, query: str, shown: int) -> dict[str, Any]:
    connection.execute(f"CREATE OR REPLACE TEMP TABLE pairs AS {query}")
    count = connection.execute("SELECT count(*) FROM pairs").fetchall()[0][0]
    pairs = connection.execute("SELECT * FROM pairs ORDER BY name LIMIT ?", [shown]).fetchall()
    return {"levels": count, "pairs": [list(pair) for pair in pairs]}


def _of_files(files: list[Path]) -> pa.Table:
    from levelproof.levelgen.identity.content import (
        content_hashes,  # here, so that a question about a split need not wait for JAX
    )
    from levelproof.levelgen.identity.signature import signatures
    from levelproof.pipeline.read.levels import level_file

    rows = []
    for path in files:
        level = level_file(path).level
        rows.append({"name": str(path), "content_hash": content_hashes(level)[0], "signature": signatures(level)[0]})
    schema = pa.schema([pa.field("name", pa.string()), *(COLUMNS.field(name) for name in COMPARED)])
    return pa.Table.from_pylist(rows, schema)
