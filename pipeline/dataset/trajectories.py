"""Manifest rows of a dataset's trajectories, which follow levels that a seal moves to other shards."""

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Int

from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.levels import rules_of
from levelproof.pipeline.read.rows import COLUMNS, current_rows, same_positions
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.columns import schema_of
from levelproof.pipeline.store.fragment import FULL
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.seed.file import is_seed

ALWAYS_COLUMNS = ("label", "steps_to_goal", *COLUMNS)
T = TypeVar("T")


class TrajectoryRows:
    """Trajectories of a split that meet a condition, by index. Safe to use from several threads.

    Attributes:
        table: their manifest rows, in the order of level ids.
        rules: task rules that they were played by.
        simulates: whether reading simulates, because records are not stored whole.
    """

    def __init__(self, split: Path, where: str | None, columns: Sequence[str]) -> None:
        """Read the manifest. Arguments and errors as `dataset.open`."""
        hashed = [] if is_seed(split) else ["content_hash"]  # of seeds on demand: it takes their levels
        columns = [*hashed, *ALWAYS_COLUMNS, *columns, *columns_in(where)]
        manifest = require_manifest(split, columns, compact=True)
        rows = select(manifest.table.filter(pc.is_valid(manifest.table["shard"])), where)  # pyright: ignore[reportAttributeAccessIssue]
        if not rows.num_rows:
            what = "has no trajectories yet" if where is None else f"has no trajectories for which {where}"
            raise UserError(f"The split {split} {what}: `levelproof inspect {split}` shows what it has.")
        rows = rows.cast(schema_of(rows.column_names))  # dictionary-encoded only while all rows were in memory
        self._split, self._lock = split, Lock()
        self.table: pa.Table = rows.combine_chunks()
        self.rules: TaskParams = rules_of(manifest)
        self.simulates = any(fragment.densities != {*FULL} for fragment in manifest.counting)

    def __len__(self) -> int:
        return self.table.num_rows

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the level ids: equal for equal selections of trajectories."""
        return hashlib.sha256(self.table["level_id"].to_numpy().tobytes()).hexdigest()[:16]

    @cached_property
    def content_hashes(self) -> list[str]:
        """Content hashes of the levels; of seeds, made from the levels at the first call."""
        table = self.table
        if "content_hash" not in table.column_names:
            table = require_manifest(self._split, ["content_hash"], table["level_id"].to_numpy()).table
        return table["content_hash"].to_pylist()

    def level_ids(self, indices: Int[np.ndarray, " batch"]) -> Int[np.ndarray, " batch"]:
        """Return the ids of levels."""
        return self.table["level_id"].take(pa.array(indices)).to_numpy()

    def gathered(self, indices: Int[np.ndarray, " batch"], gather: Callable[[pa.Table], T]) -> T:
        """Return what `gather` reads of these manifest rows; follow levels that a seal moved.

        Raises:
            UserError: an index does not exist.
            Failure: as `gather`.
        """
        if not indices.size or indices.min() < 0 or indices.max() >= len(self):
            raise UserError(f"There are no trajectories {indices.tolist()}: use indices from 0 to {len(self) - 1}.")
        while True:
            table = self.table
            try:
                return gather(table.select(COLUMNS).take(pa.array(indices)))
            except Failure:
                if not self._relocate(table):
                    raise

    def _relocate(self, table: pa.Table) -> bool:
        """Update shards and rows after a seal; return whether they differ from those of `table`."""
        with self._lock:
            if self.table is not table:
                return True
            current = current_rows(self._split, table)
            same = same_positions(table, current)
            for name in () if same else ("shard", "row"):
                at = table.schema.get_field_index(name)
                table = table.set_column(at, name, current[name].combine_chunks())
            self.table = table
            return not same
