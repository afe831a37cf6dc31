"""Levels and manifest for people who want tasks: parquet files with a row a level, its world in typed columns.

`levelproof.levels_from` makes levels of the rows again. Memory is that of a few thousand levels.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console
from rich.progress import track

from experts.witness import take
from levelgen.identity.content import content_hashes
from levelgen.sampling.sampler import CHUNK
from pipeline.errors import UserError
from pipeline.read.columns import columns_for
from pipeline.read.created import new_folder
from pipeline.read.levels import levels_of
from pipeline.read.select import select
from pipeline.store.manifest import Manifest, read_fragment, require_manifest
from pipeline.store.schema import COLUMNS

GROUP = 16 * CHUNK  # rows: what is in memory at once, and what a query reads or skips
FILE = 25 * GROUP  # rows of a file, about as many as a sealed manifest's files have

WORDS = [name for name in COLUMNS.names if pa.types.is_string(COLUMNS.field(name).type)]


def export_parquet(split: Path, where: str | None, out: Path) -> None:
    """Write the levels of `split` for which the SQL condition holds to a new folder `out`, and tell so in one line.

    Levels without a witness are made again from their ids. One that comes out otherwise here than where its row was
    made (other versions, another machine) is left out, and counted.

    Raises:
        UserError: no split, no such level, a condition that DuckDB cannot use, or a folder that is there already.
        Failure: the split is damaged, or the disk refuses.
    """
    manifest = require_manifest(split)
    rows = select(manifest.table, where)
    if not rows.num_rows:
        raise UserError(f"No level of {split} is {where}: choose another condition with --where.")
    metadata = read_fragment(manifest.fragments[0].path, [])[1].schema.metadata
    written = 0
    with new_folder(out) as folder:
        for number, first in enumerate(range(0, rows.num_rows, FILE)):
            groups = _groups(manifest, rows.slice(first, FILE))
            written += _write(folder / f"levels-{number:05d}.parquet", groups, metadata)
    left_out = rows.num_rows - written
    print(
        f"{out}: {written} levels" + (f", without {left_out} that come out otherwise here" if left_out else "") + ". "
        f'In Python: levelproof.levels_from(pyarrow.parquet.read_table("{out}"))'
    )


def _groups(manifest: Manifest, rows: pa.Table) -> Iterator[pa.Table]:
    console = Console(stderr=True)
    blocks = range(0, rows.num_rows, CHUNK)
    group: list[pa.Table] = []
    for first in track(blocks, "levels", console=console, transient=True, disable=not console.is_terminal):
        group.append(with_worlds(manifest, rows.slice(first, CHUNK)))
        if len(group) * CHUNK >= GROUP or first == blocks[-1]:
            yield pa.concat_tables(group)
            group = []


def with_worlds(manifest: Manifest, rows: pa.Table) -> pa.Table:
    """These rows of a manifest, with their levels' columns beside them, but for those that come out otherwise here."""
    level = levels_of(manifest, rows)
    same = np.ones(rows.num_rows, bool)
    made = np.flatnonzero(rows.column("shard").is_null())
    hashes = rows.column("content_hash").to_pylist()
    same[made] = [ours == hashes[i] for i, ours in zip(made, content_hashes(take(level, made)), strict=True)]
    rows = rows.filter(pa.array(same))
    for name, column in columns_for(take(level, np.flatnonzero(same))).items():
        rows = rows.append_column(name, column)
    return rows


def _write(path: Path, groups: Iterator[pa.Table], metadata: dict[bytes, bytes]) -> int:
    """The number of rows; `metadata` tells the split's configuration, and with it the rules, as its fragments do."""
    first, count = next(groups), 0
    with pq.ParquetWriter(
        path,
        first.schema.with_metadata(metadata),
        compression="zstd",
        use_dictionary=WORDS,  # pyright: ignore[reportArgumentType]  # not of numbers: it takes all NaN for one
        write_page_checksum=True,
    ) as file:
        for table in (first, *groups):
            file.write_table(table, row_group_size=GROUP)
            count += table.num_rows
    return count
