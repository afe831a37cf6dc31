"""A split opened for training: its trajectories by number, in batches, and as starts for the environment."""

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
from jaxtyping import Int
from numpy.typing import ArrayLike

from levelproof.experts.config import RECORD_STEPS
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.environment import EnvState, ObservationType
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import Size, State
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.dataset.batch import Batch, named
from levelproof.pipeline.read.dataset.batches import Batches
from levelproof.pipeline.read.dataset.observations import kind_of, observed
from levelproof.pipeline.read.dataset.order import EpochOrder
from levelproof.pipeline.read.dataset.parts import check_share, in_part
from levelproof.pipeline.read.dataset.sources import TrajectorySource
from levelproof.pipeline.read.dataset.windows import Windows
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
        validation: share of all levels that is kept for `part="validation"`.

    Raises:
        UserError: there is no split, no trajectory in it that fits, or a condition or column that is none.
        Failure: the manifest is damaged.
    """
    return Dataset(Path(path), where, columns, validation)


class Dataset:
    """Made by `levelproof.open`. Trajectories are numbered from 0 in the order of their level ids."""

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

    def __getitem__(self, number: int) -> Batch:
        """One trajectory, [time, ...], with every field, and seen as symbolic_flat.

        Raises:
            IndexError: there is none of this number.
        """
        if not -len(self) <= number < len(self):
            raise IndexError(f"There is no trajectory {number}: {self.split} has {len(self)} of these.")
        batch = self.read([number % len(self)], fields=["level", "record"])
        return jax.tree.map(lambda x: x[0], batch)

    def read(
        self,
        numbers: ArrayLike,
        length: int | None = None,
        first: ArrayLike = 0,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> Batch:
        """These trajectories, or a window of each.

        Args:
            numbers: of trajectories, one after another; one alone is as a list of one.
            length: steps of a window; None: whole records.
            first: step at which each window starts.
            fields: names of other fields, or what they are below, such as `record/state`.
            observation: one of the environment's, or None.

        Raises:
            UserError: there is no such field, observation or window.
            Failure: the data is damaged.
        """
        windows, kind, chosen = Windows.of(length), kind_of(observation), named(fields, self.size)
        numbers = np.atleast_1d(np.asarray(numbers, np.int64))
        starts = np.broadcast_to(np.asarray(first, np.int64), numbers.shape)
        _require_steps(starts)
        needed = [*chosen, *ALWAYS, *named(["level", *(["record/state"] if kind else [])], self.size)]
        arrays = windows.cut(self._arrays(numbers, needed), starts)
        level, mask = tree_of(Level, arrays, "level/"), windows.mask(starts)
        live = action_mask(jax.tree.map(lambda x: np.moveaxis(x, 0, -1), level)).T[:, None]
        return Batch(
            level_id=self._manifest["level_id"].take(pa.array(numbers)).to_numpy(),
            first=starts,
            mask=mask,
            observation=observed(kind, level, tree_of(State, arrays, "record/state/")) if kind else None,
            action=arrays["record/action"],
            action_mask=np.broadcast_to(live, arrays["record/action"].shape),
            reward=arrays["record/reward"],
            done=arrays["record/done"],
            goal=arrays["record/goal"],
            fields={name: arrays[name] for name in chosen},
        )

    def batches(
        self,
        batch: int,
        seed: int | None = None,
        part: str | None = None,
        length: int | None = None,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
        epochs: int | None = 1,
        process_index: int = 0,
        process_count: int = 1,
        ahead: int | None = None,
        start: dict[str, Any] | None = None,
    ) -> Batches:
        """Batches of trajectories, or of all their windows, read ahead by threads.

        Each comes once an epoch. The last batch is filled up, with steps whose mask is False, so that all have one
        shape and every host as many.

        Args:
            batch: trajectories or windows of a batch on this host.
            seed: of the order, which is another one in each epoch; None: by level id and step.
            part: `train` or `validation`; None: both.
            length: steps of a window; None: whole records.
            fields: names of other fields, or what they are below, such as `record/state`.
            observation: one of the environment's, or None.
            epochs: how many; None: no end.
            process_index: of this host.
            process_count: hosts that share the batches; each calls this with the same words, but for its index.
            ahead: batches that are read before they are asked for; default: two for each core.
            start: what `Batches.state` gave, to go on from there; it may come from another host.

        Raises:
            UserError: any of these is wrong, or the part is empty.
        """
        windows, numbers, fields = Windows.of(length), self._part(part), tuple(named(fields, self.size))
        kind_of(observation)
        order = EpochOrder(len(numbers) * windows.each, batch, seed, process_index, process_count)

        def load(position: int) -> Batch:
            items, new = order.items(position)
            which, first = windows.at(items)
            found = self.read(numbers[which], length, first, fields, observation)
            return replace(found, mask=found.mask & new[:, None])

        of = {"trajectories": self.fingerprint, "part": part, "validation": self._opened_with[-1], "length": length}
        of |= {"batch": batch, "seed": seed, "process_count": process_count}
        count = None if epochs is None else epochs * order.batches
        return Batches(load, count, of, 2 * len(own_cores()) if ahead is None else ahead, start)

    def grain(
        self,
        part: str | None = None,
        length: int | None = None,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> TrajectorySource:
        """Trajectories or windows one by one, as a data source for grain and a data set for a torch DataLoader.

        The words are those of `batches`; elements are dictionaries of numpy arrays [time, ...].
        """
        return TrajectorySource(self, self._part(part), part, length, named(fields, self.size), kind_of(observation))

    torch = grain

    def levels(self, numbers: ArrayLike) -> Level:
        """The levels of these trajectories as `levelproof.make` takes them, level axis last."""
        arrays = self._arrays(np.atleast_1d(np.asarray(numbers, np.int64)), named(["level"], self.size))
        return jax.tree.map(lambda x: np.ascontiguousarray(np.moveaxis(x, 0, -1)), tree_of(Level, arrays, "level/"))

    def state(self, number: ArrayLike, step: ArrayLike = 0) -> EnvState:
        """The environment's state before a step of a trajectory; of several, with an axis for them in front.

        What is played from there by the split's `rules` and the stored actions is the stored future, bit for bit, on
        the stack that made it.
        """
        numbers, steps = np.broadcast_arrays(np.asarray(number, np.int64), np.asarray(step, np.int64))
        _require_steps(steps)
        fields = named(["level", "record/state", "record/timestep", "record/last_distance"], self.size)
        arrays = self._arrays(numbers.ravel(), fields)
        rows = np.arange(numbers.size)
        arrays |= {name: x[rows, steps.ravel()] for name, x in arrays.items() if name.startswith("record/")}
        level = replace(tree_of(Level, arrays, "level/"), state=tree_of(State, arrays, "record/state/"))
        given = level, arrays["record/timestep"], arrays["record/last_distance"]
        return EnvState(*jax.tree.map(lambda x: jnp.asarray(x.reshape((*numbers.shape, *x.shape[1:]))), given))

    @cached_property
    def fingerprint(self) -> str:
        """The same for the same trajectories."""
        return hashlib.sha256(self._manifest["level_id"].to_numpy().tobytes()).hexdigest()[:16]

    def __reduce__(self) -> tuple[Any, ...]:
        """As what it was opened with: a process that gets it reads the manifest again."""
        return _opened_again, (self._opened_with, self.fingerprint)

    def __repr__(self) -> str:
        return f"levelproof.open({', '.join(map(repr, self._opened_with))}) of {many(len(self), 'trajectory')}"

    def _part(self, part: str | None) -> Int[np.ndarray, " number"]:
        share = self._opened_with[-1]
        numbers = np.flatnonzero(in_part(self._manifest["content_hash"].to_pylist(), part, share))
        if not len(numbers):
            raise UserError(
                f"None of the {len(self)} trajectories is in the part {part}: open with another validation=."
            )
        return numbers

    def _arrays(self, numbers: Int[np.ndarray, " batch"], fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Named arrays of trajectories, level axis first; looked for again where a seal has moved them."""
        if not numbers.size or numbers.min() < 0 or numbers.max() >= len(self):
            raise UserError(f"There are no trajectories {numbers.tolist()}: give some from 0 to {len(self) - 1}.")
        while True:
            manifest = self._manifest
            try:
                return read_placed(self.split, manifest.select(COLUMNS).take(pa.array(numbers)), fields, self._shard)
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


def _opened_again(opened_with: tuple, fingerprint: str) -> Dataset:
    data = Dataset(*opened_with)
    if data.fingerprint != fingerprint:
        raise Failure(f"The split {data.split} has other trajectories than it had: open it again.")
    return data
