"""Duplicate levels: within a split, in another split, or among level files.

Levels with equal `content_hash` are the same; levels that share half of a `signature` are near (docs/levels.md).
DuckDB groups and joins. Each level is reported with one partner only, so a split of many copies has a short report.
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
from levelproof.pipeline.read.level_files import level_file_paths
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.layout import MANIFEST
from levelproof.pipeline.store.manifest import refuse_folder_of_splits, require_manifest
from levelproof.pipeline.store.seed.file import is_seed

COMPARED = ("content_hash", "signature")
# Candidates share half of a signature; equal content has equal signatures. Grouping 8-byte hashes takes a tenth of the
# time and memory of grouping strings.
HALVES = ("signature[1]", "signature[2]")
CONTENT = "content"  # column of 64-bit hashes of `content_hash`
NUMBERS = (CONTENT, *HALVES)
# One odd multiplier per 8-byte word of a string
FACTORS = np.random.default_rng(0).integers(0, 2**63, 64, np.uint64) * 2 + 1
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

Duplicates = dict[str, dict[str, Any]]  # same, near -> levels (count), pairs (first few: a level and its partner)


def comparison_table(manifest_table: pa.Table) -> pa.Table:
    """Select the compared columns of a manifest's rows; the level id becomes the name."""
    return manifest_table.select(["level_id", *COMPARED]).rename_columns(["name", *COMPARED])


def comparison_of_levels(split: Path, level_ids: np.ndarray) -> pa.Table:
    """Read the compared columns of these levels of a split."""
    return comparison_table(require_manifest(split, COMPARED, level_ids).table)


def hash_identities(rows: pa.Table, kept: Sequence[str]) -> pa.Table:
    """Add 64-bit hashes of the compared columns; drop those columns unless they are in `kept`."""
    half = lambda i: pc.list_element(rows["signature"], i)  # pyright: ignore[reportAttributeAccessIssue]
    numbers = {CONTENT: hash_strings(rows["content_hash"])} | {
        name: hash_strings(half(i)) for i, name in enumerate(HALVES)
    }
    for name, values in numbers.items():
        rows = rows.append_column(name, pa.array(values))
    return rows.drop_columns([name for name in COMPARED if name not in kept])


def find_candidates(levels: pa.Table) -> pa.Table:
    """Select the levels (from `hash_identities`) that share half of a signature with another, for comparison.

    In one of a million splits of 6 million levels, two contents have the same 64-bit hash by chance.
    """
    with ThreadPoolExecutor() as threads:  # sorting dominates the time
        shared = list(threads.map(_repeated, (levels[name].to_numpy() for name in HALVES)))
    alike = levels.select(["level_id", *NUMBERS]).filter(shared[0] | shared[1])
    halves = np.stack([alike[name].to_numpy() for name in HALVES], 1)
    signature = pa.FixedSizeListArray.from_arrays(pa.array(halves.reshape(-1)), len(HALVES)).cast(pa.list_(pa.int64()))
    return pa.table({"name": alike["level_id"], "content_hash": alike[CONTENT], "signature": signature})


def _repeated(values: np.ndarray) -> np.ndarray:
    """Mask of the values that occur more than once."""
    ordered = np.sort(values)  # `argsort` would take four times as long
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    repeated = pc.is_in(pa.array(values), pa.array(twice))  # pyright: ignore[reportAttributeAccessIssue]
    return repeated.to_numpy(zero_copy_only=False)


def hash_strings(strings: pa.ChunkedArray) -> np.ndarray:
    """Hash the bytes of each string to 64 bits: the dot product of its words with FACTORS, plus its length."""
    array = pa.concat_arrays([pa.array([], pa.string()), *strings.chunks])
    widths = pc.binary_length(array).to_numpy()  # pyright: ignore[reportAttributeAccessIssue]
    numbers = np.zeros(len(array), np.uint64)
    for width in np.unique(widths).tolist():  # nearly always a single width
        mine = np.flatnonzero(widths == width)
        of_width = array if len(mine) == len(array) else array.take(pa.array(mine))
        padded = np.zeros((len(mine), -(-width // 8) * 8), np.uint8)
        padded[:, :width] = np.frombuffer(of_width.buffers()[2], np.uint8, len(mine) * width).reshape(len(mine), width)
        words = padded.view(np.uint64)
        numbers[mine] = words @ np.resize(FACTORS, words.shape[1]) + np.uint64(width)
    return numbers.view(np.int64)


def comparison_of_source(source: Path) -> pa.Table:
    """Read the compared columns of a split, a level file, or all level files below a folder (named by path).

    Raises:
        UserError: the source has neither, or a level file is invalid.
        Failure: a fragment is damaged.
    """
    if source.is_file() and not is_seed(source):
        return _of_files([source])
    if not source.is_dir() or (source / MANIFEST).is_dir() or is_seed(source):
        return comparison_table(require_manifest(source, COMPARED).table)
    if not (files := level_file_paths(source)):
        refuse_folder_of_splits(source)
        raise UserError(f"{source} has neither a split nor a level file: give a folder that has one.")
    return _of_files(files)


def within(levels: pa.Table, shown: int) -> Duplicates:
    """Find levels with the same content as an earlier one, and distinct contents near an earlier one."""
    with duckdb.connect() as connection:
        connection.register("levels", levels)
        connection.execute(ALIKE_WITHIN)
        queries = {"same": SAME.format(theirs="alike"), "near": NEAR.format(ours=FIRST, theirs=FIRST)}
        return {
            name: _pairs(connection, f"FROM ({query}) WHERE partner < name", shown) for name, query in queries.items()
        }


def between(levels: pa.Table, others: pa.Table, shown: int) -> Duplicates:
    """Find levels with the same content as one of the others and, among the rest, levels near one of them."""
    with duckdb.connect() as connection:
        connection.register("levels", levels)
        connection.register("others", others)
        connection.execute(ALIKE_BETWEEN.format(alike="alike", levels="levels", others="others"))
        connection.execute(ALIKE_BETWEEN.format(alike="there", levels="others", others="alike"))
        queries = {"same": SAME.format(theirs="there"), "near": NEAR.format(ours=OTHERS, theirs="FROM there")}
        return {name: _pairs(connection, query, shown) for name, query in queries.items()}


def describe(duplicates: Duplicates) -> str:
    """Describe in words: counts, and the first pair of each kind."""
    words = []
    for kind, entry in duplicates.items():
        example = " (such as {} and {})".format(*entry["pairs"][0]) if entry["pairs"] else ""
        words.append(f"{entry['levels']:,} {kind}{example}")
    return ", ".join(words)


def _pairs(connection: duckdb.DuckDBPyConnection, query: str, shown: int) -> dict[str, Any]:
    connection.execute(f"CREATE OR REPLACE TEMP TABLE pairs AS {query}")
    count = connection.execute("SELECT count(*) FROM pairs").fetchall()[0][0]
    pairs = connection.execute("SELECT * FROM pairs ORDER BY name LIMIT ?", [shown]).fetchall()
    return {"levels": count, "pairs": [list(pair) for pair in pairs]}


def _of_files(files: list[Path]) -> pa.Table:
    # Imported here, so that comparing splits need not wait for JAX
    from levelproof.levelgen.identity.content import content_hashes
    from levelproof.levelgen.identity.signature import signatures
    from levelproof.pipeline.read.levels import level_file

    rows = []
    for path in files:
        level = level_file(path).level
        rows.append({"name": str(path), "content_hash": content_hashes(level)[0], "signature": signatures(level)[0]})
    schema = pa.schema([pa.field("name", pa.string()), *(COLUMNS.field(name) for name in COMPARED)])
    return pa.Table.from_pylist(rows, schema)
