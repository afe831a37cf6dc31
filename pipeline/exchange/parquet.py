"""Export of levels and manifest to parquet files: one row per level, its world in typed columns.

`levelproof.levels_from` converts rows back to levels. Memory holds a few thousand levels at a time.
"""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from levelproof.levelgen.batching import take
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.pipeline.exchange.tables import columns_for
from levelproof.pipeline.read.levels import levels_of, with_known_costs
from levelproof.pipeline.read.select import columns_in, select_some
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.columns import COLUMNS
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.manifest import Manifest, require_manifest, settings_metadata
from levelproof.pipeline.store.progress_bar import ProgressBar
from levelproof.pipeline.words import many

GROUP = 16 * CHUNK  # rows per row group: those in memory at a time, and the unit that a query reads or skips
FILE = 25 * GROUP  # rows per file, about as many as in a file of a sealed manifest

STRING_COLUMNS = [name for name in COLUMNS.names if pa.types.is_string(COLUMNS.field(name).type)]


def export_parquet(split: Path, where: str | None, out: Path) -> None:
    """Write the levels of `split` that meet the condition (None: all) to a new folder `out`; print a summary.

    Regenerates levels without a witness from their ids. Omits and counts those that differ here from their row, as on
    other versions or another machine.

    Raises:
        UserError: the split does not exist, the condition is invalid, no level meets it, or `out` exists or cannot be
            written.
        Failure: the split is damaged.
    """
    prepare_jax()  # hashes of seeds are computed as they are asked for
    manifest = require_manifest(split, columns_in(where), compact=True)
    ids = select_some(split, manifest.table, where).column("level_id").to_numpy()
    metadata = settings_metadata(manifest.fragments[0].config_hash, manifest.fragments[0].config)
    written = 0
    with new_folder(out) as folder:
        for index, first in enumerate(range(0, len(ids), FILE)):
            groups = _groups(split, ids[first : first + FILE])
            written += _write(folder / f"levels-{index:05d}.parquet", groups, metadata)
    left_out = len(ids) - written
    print(
        f"{out}: {many(written, 'level')}"
        + (f", without {left_out} that differ on this machine" if left_out else "")
        + ". "
        f'In Python: levelproof.levels_from(pyarrow.parquet.read_table("{out}"))'
    )


def _groups(split: Path, ids: np.ndarray) -> Iterator[pa.Table]:
    """Yield tables of rows and worlds of these levels, GROUP rows each."""
    with ProgressBar("levels", len(ids), Console(stderr=True)) as progress:
        for first in range(0, len(ids), GROUP):
            manifest, group = require_manifest(split, level_ids=ids[first : first + GROUP]), []
            table = with_known_costs(manifest)
            for rows in (table.slice(block, CHUNK) for block in range(0, table.num_rows, CHUNK)):
                group.append(with_worlds(manifest, rows))
                progress.advance(rows.num_rows)
            yield pa.concat_tables(group)


def with_worlds(manifest: Manifest, rows: pa.Table) -> pa.Table:
    """Append level columns to manifest rows, without rows whose level differs on this machine."""
    level = levels_of(manifest, rows)
    same = np.ones(rows.num_rows, bool)
    generated = np.flatnonzero(rows.column("shard").is_null())
    hashes = rows.column("content_hash").to_pylist()
    ours = content_hashes(take(level, generated))
    same[generated] = [own == hashes[i] for i, own in zip(generated, ours, strict=True)]
    rows = rows.filter(pa.array(same))
    for name, column in columns_for(take(level, np.flatnonzero(same))).items():
        rows = rows.append_column(name, column)
    return rows


def _write(path: Path, groups: Iterator[pa.Table], metadata: dict[bytes, bytes]) -> int:
    """Write a file; return its number of rows."""
    first, count = next(groups), 0
    with pq.ParquetWriter(
        path,
        first.schema.with_metadata(metadata),
        compression="zstd",
        use_dictionary=STRING_COLUMNS,  # pyright: ignore[reportArgumentType]  # dictionaries of numbers would merge all NaN
        write_page_checksum=True,
    ) as file:
        for table in chain([first], groups):
            file.write_table(table, row_group_size=GROUP)
            count += table.num_rows
    return count
