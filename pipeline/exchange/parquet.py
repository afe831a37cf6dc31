"""Levels and manifest for people who want tasks: parquet files with a row a level, its world in typed columns.

`levelproof.levels_from` makes levels of the rows again. Memory is that of a few thousand levels.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from levelproof.levelgen.batching import take
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.exchange.tables import columns_for
from levelproof.pipeline.read.levels import levels_of
from levelproof.pipeline.read.pace import Pace
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.manifest import Manifest, require_manifest, settings_metadata
from levelproof.pipeline.words import many

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
    manifest = require_manifest(split, columns_in(where), compact=True)
    ids = select(manifest.table, where).column("level_id").to_numpy()
    if not len(ids):
        raise UserError(f"No level of {split} is {where}: choose another condition with --where.")
    metadata = settings_metadata(manifest.fragments[0].config_hash, manifest.fragments[0].config)
    written = 0
    with new_folder(out) as folder:
        for number, first in enumerate(range(0, len(ids), FILE)):
            groups = _groups(split, ids[first : first + FILE])
            written += _write(folder / f"levels-{number:05d}.parquet", groups, metadata)
    left_out = len(ids) - written
    print(
        f"{out}: {many(written, 'level')}"
        + (f", without {left_out} that come out otherwise here" if left_out else "")
        + ". "
        f'In Python: levelproof.levels_from(pyarrow.parquet.read_table("{out}"))'
    )


def _groups(split: Path, ids: np.ndarray) -> Iterator[pa.Table]:
    """Rows and worlds of these levels, GROUP of them at a time."""
    with Pace("levels", len(ids), Console(stderr=True)) as pace:
        for first in range(0, len(ids), GROUP):
            manifest, group = require_manifest(split, level_ids=ids[first : first + GROUP]), []
            for rows in (manifest.table.slice(block, CHUNK) for block in range(0, manifest.table.num_rows, CHUNK)):
                group.append(with_worlds(manifest, rows))
                pace.advance(rows.num_rows)
            yield pa.concat_tables(group)


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
    """The number of rows."""
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
