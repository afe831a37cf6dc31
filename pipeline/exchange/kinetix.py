"""Export to the reference's format: a folder that `kinetix.data.TrajectoryDatasetManager` opens."""

from pathlib import Path

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.level import Level, size_of
from levelproof.pipeline.read.kinetix.records import dtype_of, trajectories_of
from levelproof.pipeline.read.kinetix.zarr2 import ROWS, write_array, write_chunk, write_group
from levelproof.pipeline.read.level_files import rule_settings
from levelproof.pipeline.read.levels import rules_of
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.read.select import SOLVED, select_witnessed
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.progress_bar import shown_blocks
from levelproof.pipeline.store.shard import stored_bytes
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import many

BLOCK = 4 * ROWS  # trajectories in memory at a time
ARRAY = 64 * ROWS  # trajectories per array: the reference shuffles arrays, and trajectories within each


def export_kinetix(split: Path, where: str | None, out: Path) -> None:
    """Write the witnesses of `split` that meet the condition (None: solved) to a new folder `out`; print a summary.

    Raises:
        UserError: the split does not exist, the condition is invalid, no level qualifies, or `out` exists.
        Failure: the split is damaged.
    """
    prepare_jax()
    rows = select_witnessed(split, where or SOLVED)
    count = rows.num_rows
    rules = rule_settings(rules_of(require_manifest(split, [], rows["level_id"][:1].to_numpy())))
    with new_folder(out) as folder:
        for first in shown_blocks(count, BLOCK, "trajectories"):
            fields = read_rows(split, rows.slice(first, BLOCK))
            trajectories = trajectories_of(tree_of(Level, fields, "level/"), tree_of(Record, fields, "record/"))
            array, at = divmod(first, ARRAY)
            for row in range(0, len(trajectories), ROWS):
                write_chunk(folder / array_name(array), (at + row) // ROWS, trajectories[row : row + ROWS])
        dtype = dtype_of(size_of(rows.column("size")[0].as_py()))
        for first in range(0, count, ARRAY):
            write_array(folder / array_name(first // ARRAY), min(ARRAY, count - first), dtype)
        write_group(folder)
    if rules:
        print(f"The rules differ from the defaults, and the layout does not hold them: {' '.join(rules)}.")
    print(
        f"{out}: {many(count, 'trajectory')} of {as_typed(split)}, "
        f"{stored_bytes(out) / (count * RECORD_STEPS):.0f} bytes per transition.\n"
        f'Next:  kinetix.data.TrajectoryDatasetManager("{out}", batch_size=64)'
    )


def array_name(index: int) -> str:
    """Name an array so that names sort by index."""
    return f"{index:06d}"
