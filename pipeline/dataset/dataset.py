"""A split opened for training: its trajectories by index, in batches, and as starts for the environment."""

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Int
from numpy.typing import ArrayLike

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.environment import EnvState, ObservationType
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import Size, State
from levelproof.pipeline.dataset.batch import Batch, named
from levelproof.pipeline.dataset.batches import Batches
from levelproof.pipeline.dataset.observations import kind_of, observed
from levelproof.pipeline.dataset.order import EpochOrder
from levelproof.pipeline.dataset.renamed import renamed
from levelproof.pipeline.dataset.sources import TrajectorySource
from levelproof.pipeline.dataset.subsets import check_share, in_subset
from levelproof.pipeline.dataset.windows import Windows
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.levels import rules_of
from levelproof.pipeline.read.rows import COLUMNS, moved_rows, read_placed, same_places
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.columns import schema_of
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.shard import open_shard
from levelproof.pipeline.words import many

READ = ("content_hash", "label", "steps_to_goal", *COLUMNS)  # columns of the manifest that are always read
OPEN_SHARDS = 256  # whose indices are kept in memory
ALWAYS = ("record/action", "record/reward", "record/done", "record/goal")


def open(
    path: str | os.PathLike[str], where: str | None = None, columns: Sequence[str] = (), validation: float = 0.1
) -> "Dataset":
    """The trajectories of a split, for training.

    Args:
        path: of the split, such as `data/1M/s`, or its URL (docs/remote.md).
        where: an SQL condition on the manifest's columns, such as `label = 'solved' AND steps_to_goal < 64`.
        columns: of the manifest, to have in `Dataset.manifest` beside those that are always read.
        validation: share of all levels that is kept for `subset="validation"`.

    Raises:
        UserError: there is no split, no trajectory in it that fits, or a condition or column that is none.
        Failure: the manifest is damaged.
    """
    return Dataset(Path(path), where, columns, validation)


class Dataset:
    """Made by `levelproof.open`. Trajectories have indices from 0 in the order of their level ids."""

    def __init__(self, split: Path, where: str | None, columns: Sequence[str], validation: float) -> None:
        self.split, self._opened_with = split, (split, where, columns, validation)
        manifest = require_manifest(split, [*READ, *columns, *columns_in(where)], compact=True)
        rows = select(manifest.table.filter(pc.is_valid(manifest.table["shard"])), where)  # pyright: ignore[reportAttributeAccessIssue]
        if not rows.num_rows:
            what = "has no trajectories yet" if where is None else f"has no trajectories for which {where}"
            raise UserError(f"The split {split} {what}: `levelproof inspect {split}` shows what it has.")
        check_share(validation)
        rows = rows.cast(schema_of(rows.column_names))  # dictionaries while there are rows of all levels, no longer
        self._manifest, self._lock = rows.combine_chunks(), Lock()
        self._shard = lru_cache(OPEN_SHARDS)(open_shard)
        self.rules: TaskParams = rules_of(manifest)

    @property
    def manifest(self) -> pa.Table:
        """The manifest's rows of the trajectories, in their order."""
        return self._manifest

    @cached_property
    def size(self) -> Size:
        """Of all levels."""
        return size_of(self._manifest["size"][0].as_py())

    def __len__(self) -> int:
        return self._manifest.num_rows

    def __getitem__(self, index: int) -> Batch:
        """One trajectory, [time, ...], with every field, and seen as symbolic_flat.

        Raises:
            IndexError: there is none with this index.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"There is no trajectory {index}: {self.split} has {len(self)} of these.")
        batch = self.read([index % len(self)], fields=["level", "record"])
        return jax.tree.map(lambda x: x[0], batch)

    @renamed(numbers="indices")
    def read(
        self,
        indices: ArrayLike,
        length: int | None = None,
        first: ArrayLike = 0,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> Batch:
        """These trajectories, or a window of each.

        Args:
            indices: of trajectories, in any order; one alone is as a list of one.
            length: steps of a window; None: whole records.
            first: step at which each window starts.
            fields: names of other fields, or what they are below, such as `record/state`.
            observation: one of the environment's, or None.

        Raises:
            UserError: there is no such field, observation or window.
            Failure: the data is damaged.
        """
        windows, kind, chosen = Windows.of(length), kind_of(observation), named(fields, self.size)
        indices = np.atleast_1d(np.asarray(indices, np.int64))
        starts = np.broadcast_to(np.asarray(first, np.int64), indices.shape)
        _require_steps(starts)
        needed = [*chosen, *ALWAYS, *named(["level", *(["record/state"] if kind else [])], self.size)]
        whole = self._arrays(indices, needed)
        timed_out = _timed_out(whole["record/done"], whole["record/goal"], self.rules.max_timesteps)
        arrays = windows.cut(whole | {"record/truncated": timed_out}, starts)
        level, mask = tree_of(Level, arrays, "level/"), windows.mask(starts)
        live = action_mask(jax.tree.map(lambda x: np.moveaxis(x, 0, -1), level)).T[:, None]
        return Batch(
            level_id=self._manifest["level_id"].take(pa.array(indices)).to_numpy(),
            first=starts,
            mask=mask,
            observation=observed(kind, level, tree_of(State, arrays, "record/state/")) if kind else None,
            action=arrays["record/action"],
            action_mask=np.broadcast_to(live, arrays["record/action"].shape),
            reward=arrays["record/reward"],
            done=arrays["record/done"],
            terminated=arrays["record/done"] & ~arrays["record/truncated"],
            truncated=arrays["record/truncated"],
            goal=arrays["record/goal"],
            fields={name: arrays[name] for name in chosen},
        )

    @renamed(batch="batch_size", part="subset", ahead="prefetch")
    def batches(
        self,
        batch_size: int,
        seed: int | None = None,
        subset: str | None = None,
        length: int | None = None,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
        epochs: int | None = 1,
        process_index: int = 0,
        process_count: int = 1,
        prefetch: int | None = None,
        start: dict[str, Any] | None = None,
    ) -> Batches:
        """Batches of trajectories, or of all their windows, read ahead by threads.

        Each comes once an epoch. The last batch is filled up, with steps whose mask is False, so that all have one
        shape and every host as many.

        Args:
            batch_size: trajectories or windows of a batch on this host.
            seed: of the order, which is another one in each epoch; None: by level id and step.
            subset: `train` or `validation`, told apart by what levels consist of; None: both.
            length: steps of a window; None: whole records.
            fields: names of other fields, or what they are below, such as `record/state`.
            observation: one of the environment's, or None.
            epochs: how many; None: no end.
            process_index: of this host.
            process_count: hosts that share the batches; each calls this with the same words, but for its index.
            prefetch: batches that are read before they are asked for; default: two for each core.
            start: what `Batches.state` gave, to go on from there; it may come from another host.

        Raises:
            UserError: any of these is wrong, or the subset is empty.
        """
        windows, indices, fields = Windows.of(length), self._subset(subset), tuple(named(fields, self.size))
        kind_of(observation)
        order = EpochOrder(len(indices) * windows.each, batch_size, seed, process_index, process_count)

        def load(position: int) -> Batch:
            items, new = order.items(position)
            which, first = windows.at(items)
            found = self.read(indices[which], length, first, fields, observation)
            return replace(found, mask=found.mask & new[:, None])

        of = {"trajectories": self.fingerprint, "subset": subset, "validation": self._opened_with[-1], "length": length}
        of |= {"batch_size": batch_size, "seed": seed, "process_count": process_count}
        count = None if epochs is None else epochs * order.batches
        return Batches(load, count, of, 2 * len(own_cores()) if prefetch is None else prefetch, start)

    @renamed(part="subset")
    def grain(
        self,
        subset: str | None = None,
        length: int | None = None,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> TrajectorySource:
        """Trajectories or windows one by one, as a data source for grain and a data set for a torch DataLoader.

        The arguments are those of `batches`; elements are dictionaries of numpy arrays [time, ...].
        """
        chosen = named(fields, self.size)
        return TrajectorySource(self, self._subset(subset), subset, length, chosen, kind_of(observation))

    torch = grain

    @renamed(numbers="indices")
    def levels(self, indices: ArrayLike) -> Level:
        """The levels of these trajectories as `levelproof.make` takes them, level axis last."""
        arrays = self._arrays(np.atleast_1d(np.asarray(indices, np.int64)), named(["level"], self.size))
        return jax.tree.map(lambda x: np.ascontiguousarray(np.moveaxis(x, 0, -1)), tree_of(Level, arrays, "level/"))

    @renamed(number="index")
    def state(self, index: ArrayLike, step: ArrayLike = 0) -> EnvState:
        """The environment's state before a step of a trajectory; of several, with an axis for them in front.

        Its `level_index` is the trajectory's index.

        What is played from there by the split's `rules` and the stored actions is the stored future, bit for bit, on
        the stack that made it.
        """
        indices, steps = np.broadcast_arrays(np.asarray(index, np.int64), np.asarray(step, np.int64))
        _require_steps(steps)
        fields = named(["level", "record/state", "record/timestep", "record/last_distance"], self.size)
        arrays = self._arrays(indices.ravel(), fields)
        rows = np.arange(indices.size)
        arrays |= {name: x[rows, steps.ravel()] for name, x in arrays.items() if name.startswith("record/")}
        level = replace(tree_of(Level, arrays, "level/"), state=tree_of(State, arrays, "record/state/"))
        counts = indices.ravel().astype(np.int32), np.zeros(indices.size, np.int32)
        given = level, arrays["record/timestep"], arrays["record/last_distance"], *counts
        return EnvState(*jax.tree.map(lambda x: jnp.asarray(x.reshape((*indices.shape, *x.shape[1:]))), given))

    @cached_property
    def fingerprint(self) -> str:
        """The same for the same trajectories."""
        return hashlib.sha256(self._manifest["level_id"].to_numpy().tobytes()).hexdigest()[:16]

    def __reduce__(self) -> tuple[Any, ...]:
        """As what it was opened with: a process that gets it reads the manifest again."""
        return _opened_again, (self._opened_with, self.fingerprint)

    def __repr__(self) -> str:
        return f"levelproof.open({', '.join(map(repr, self._opened_with))}) of {many(len(self), 'trajectory')}"

    def _subset(self, subset: str | None) -> Int[np.ndarray, " index"]:
        share = self._opened_with[-1]
        indices = np.flatnonzero(in_subset(self._manifest["content_hash"].to_pylist(), subset, share))
        if not len(indices):
            raise UserError(
                f"None of the {len(self)} trajectories is in the subset {subset}: open with another validation=."
            )
        return indices

    def _arrays(self, indices: Int[np.ndarray, " batch"], fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Named arrays of trajectories, level axis first; looked for again where a seal has moved them."""
        if not indices.size or indices.min() < 0 or indices.max() >= len(self):
            raise UserError(f"There are no trajectories {indices.tolist()}: give some from 0 to {len(self) - 1}.")
        while True:
            manifest = self._manifest
            try:
                return read_placed(self.split, manifest.select(COLUMNS).take(pa.array(indices)), fields, self._shard)
            except Failure:
                if not self._found_again(manifest):
                    raise

    def _found_again(self, manifest: pa.Table) -> bool:
        """Whether shards of this manifest have been replaced by others, which are known now."""
        with self._lock:
            if self._manifest is not manifest:
                return True
            moved = moved_rows(self.split, manifest)
            same = same_places(manifest, moved)
            for name in () if same else ("shard", "row"):
                at = manifest.schema.get_field_index(name)
                manifest = manifest.set_column(at, name, moved[name].combine_chunks())
            self._manifest = manifest
            return not same


def _require_steps(steps: np.ndarray) -> None:
    if ((steps < 0) | (steps >= RECORD_STEPS)).any():
        raise UserError(f"There are no steps {steps.tolist()} in a record: give some from 0 to {RECORD_STEPS - 1}.")


def _timed_out(
    done: Bool[np.ndarray, "item time"], goal: Bool[np.ndarray, "item time"], limit: int
) -> Bool[np.ndarray, "item time"]:
    """Steps of whole records at which the time limit, env steps, ended an episode that had not reached its goal."""
    steps = np.arange(done.shape[1])
    starts = np.where(done, steps + 1, 0)[:, :-1]  # of the episode after each end
    start = np.maximum.accumulate(np.pad(starts, [(0, 0), (1, 0)]), 1)
    return done & ~goal & (steps - start + 1 >= limit)


def _opened_again(opened_with: tuple, fingerprint: str) -> Dataset:
    data = Dataset(*opened_with)
    if data.fingerprint != fingerprint:
        raise Failure(f"The split {data.split} has other trajectories than it had: open it again.")
    return data
