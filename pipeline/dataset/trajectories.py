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

from levelproof.levelgen.identity.content import VERSION
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.levels import rules_of
from levelproof.pipeline.read.rows import COLUMNS, current_rows, same_positions
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.columns import schema_of
from levelproof.pipeline.store.fragment import FULL
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.mapped import find_table, share_table
from levelproof.pipeline.store.seed.file import describe_seed, is_seed, name_of_table, seed_files
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.urls import quoted

ALWAYS_COLUMNS = ("label", "steps_to_goal", *COLUMNS)
T = TypeVar("T")


class TrajectoryRows:
    """Trajectories of a split that meet a condition, by index. Safe to use from several threads.

    Attributes:
        table: their manifest rows, in the order of level ids.
        rules: task rules that they were played by.
        simulates: whether reading simulates, because records are not stored whole.
        of_seeds: whether they are those of seed files.
    """

    def __init__(
        self, split: Path, where: str | None, columns: Sequence[str] | str, fingerprint: str | None = None
    ) -> None:
        """Read the manifest; other arguments and errors as `dataset.open`.

        With the `fingerprint` of the trajectories that another process opened, use the table that it shared, if any.
        """
        self._split, self._lock, self.of_seeds = split, Lock(), is_seed(split)
        hashed = [] if self.of_seeds else ["content_hash"]  # of seeds on demand: it takes their levels
        named = [columns] if isinstance(columns, str) else columns
        columns = [*hashed, *ALWAYS_COLUMNS, *named, *columns_in(where)]
        self._kind = f"trajectories with {columns}"
        found = None if fingerprint is None else self._found(self._kind, fingerprint)
        if found is None:
            self._read(where, columns)
            pa.default_memory_pool().release_unused()  # to read takes several times what is kept
        else:
            path = seed_files(split)[0]
            self.table, self.simulates = found, True
            self.rules = LevelSource.of(describe_seed(path).fragment.config, path).rules

    def _read(self, where: str | None, columns: Sequence[str]) -> None:
        """Read the manifest, and share the rows of seeds."""
        split = self._split
        manifest = require_manifest(split, columns, compact=True)
        rows = select(manifest.table.filter(pc.is_valid(manifest.table["shard"])), where)  # pyright: ignore[reportAttributeAccessIssue]
        if not rows.num_rows:
            what = "has no trajectories yet" if where is None else f"has no trajectories for which {where} holds"
            raise UserError(f"The split {split} {what}: `levelproof inspect {quoted(split)}` shows what it has.")
        rows = rows.cast(schema_of(rows.column_names))  # dictionary-encoded only while all rows were in memory
        self.table: pa.Table = rows.combine_chunks()
        self.table = self._shared(self._kind, self.table)
        self.rules: TaskParams = rules_of(manifest)
        self.simulates = any(fragment.densities != {*FULL} for fragment in manifest.counting)

    def __len__(self) -> int:
        return self.table.num_rows

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the level ids and of the steps to the goal: equal for equal selections of equal trajectories."""
        digest = hashlib.sha256()
        for name in ("level_id", "steps_to_goal"):
            digest.update(self.table[name].fill_null(0).to_numpy().tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def hashes(self) -> pa.ChunkedArray:
        """Content hashes as a column of Arrow, of which millions take little memory."""
        if "content_hash" in self.table.column_names:
            return self.table["content_hash"]
        kind = f"content hashes of versions {SAMPLER_VERSION} and {VERSION}"
        table = self._found(kind, self.fingerprint)
        if table is None:
            ids = self.table["level_id"].to_numpy()
            table = self._shared(kind, require_manifest(self._split, ["content_hash"], ids).table)
        return table["content_hash"]

    def _found(self, kind: str, fingerprint: str) -> pa.Table | None:
        """Return a table of these trajectories that another process has shared."""
        name = self._name(kind, fingerprint)
        return None if name is None else find_table(name)

    def _shared(self, kind: str, table: pa.Table) -> pa.Table:
        """Return a table of these trajectories from memory that processes share, if it is large and of seeds."""
        name = self._name(kind, self.fingerprint)
        return table if name is None else share_table(name, table)

    def _name(self, kind: str, fingerprint: str) -> str | None:
        return name_of_table(f"{kind} {fingerprint}", seed_files(self._split)) if self.of_seeds else None

    def level_ids(self, indices: Int[np.ndarray, " batch"]) -> Int[np.ndarray, " batch"]:
        """Return the ids of levels."""
        return self.table["level_id"].take(pa.array(indices)).to_numpy()

    def gathered(self, indices: Int[np.ndarray, " batch"], gather: Callable[[pa.Table], T]) -> T:
        """Return what `gather` reads of these manifest rows; follow levels that a seal moved.

        Raises:
            UserError: an index does not exist.
            Failure: as `gather`.
        """
        if not indices.size:
            raise UserError("No trajectories to read: pass at least one index.")
        if len(wrong := indices[(indices < 0) | (indices >= len(self))]):
            raise UserError(f"There is no trajectory {wrong[0]}: use indices from 0 to {len(self) - 1}.")
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
