"""The reader of a split for training: trajectories by index, batches, and states to start the environment from."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
from jaxtyping import Int
from numpy.typing import ArrayLike

from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.environment import EnvState
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.physics.types import Size, State
from levelproof.pipeline.dataset.batch import (
    TRUNCATED,
    Batch,
    batch_of,
    expand_fields,
    in_a_row,
    require_steps,
    state_in,
    timed_out,
    whole_numbers,
)
from levelproof.pipeline.dataset.batches import Batches, batches_of
from levelproof.pipeline.dataset.differing import KEEP, Differing
from levelproof.pipeline.dataset.episodes import GOAL, EpisodeBatch, gather_episodes
from levelproof.pipeline.dataset.observations import observe, parse_observation
from levelproof.pipeline.dataset.order import EpochOrder, as_int
from levelproof.pipeline.dataset.records import Records, loaded_together
from levelproof.pipeline.dataset.sources import TrajectorySource
from levelproof.pipeline.dataset.subsets import check_share, in_subset
from levelproof.pipeline.dataset.trajectories import TrajectoryRows
from levelproof.pipeline.dataset.windows import Windows
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.rows import gather_rows
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.words import many

EPISODES_AT_ONCE = 1024  # read together for batches of episodes, so that many lanes are busy
# Shards whose ids and indices are cached. These take 9 kB a shard and 24 to 88 bytes a level, less than the level's
# manifest row. Opening a shard of 100,000 levels again takes a tenth of a second
OPEN_SHARDS = 4096
OPEN_SEEDS = 256  # seed files whose tables are mapped, one or two open files each
ALWAYS_FIELDS = ("record/action", "record/reward", "record/done", "record/goal")


def open(
    path: str | os.PathLike[str],
    where: str | None = None,
    columns: Sequence[str] | str = (),
    validation: float = 0.1,
    differing: str = KEEP,
) -> "Dataset":
    """Open the trajectories of a split for training.

    A trajectory is a level's witness: 256 env steps with automatic reset, in which every episode that ends reaches the
    goal. Reads the manifest now, trajectories on demand.

    Args:
        path: path or URL of the split, such as `data/1M/s`, or of seed files: one, or a folder (docs/seeds.md).
        where: SQL condition on the manifest's columns, such as `label = 'solved' AND steps_to_goal < 64`; None: all.
        columns: manifest columns to include in `Dataset.manifest`, besides those that are always read.
        validation: share of all levels, 0 to 1, that belongs to `subset="validation"`.
        differing: what to do with levels for which this machine's engine computes other states than the stored ones,
            or another end of the episode: `keep` them, with one warning of the class `EngineDiffers`; `leave_out`:
            also set `mask` False in all their steps; `raise` a Failure. `Dataset.differing` lists them.

    Raises:
        UserError: the split does not exist, no trajectory meets the condition, or an argument is invalid.
        Failure: the manifest is damaged, or was written by another version.
    """
    return Dataset(Path(path), where, columns, validation, differing)


class Dataset:
    """Trajectories of a split, from `levelproof.open`; indices from 0, in the order of level ids.

    `len(data)` is the number of trajectories, `data[i]` one of them. Safe to use from several threads; its pickle is
    small and reopens the split.

    Attributes:
        split: path or URL of the split.
        rules: task rules that the trajectories were played by.
        simulates: whether reading simulates, because records are not stored whole.
    """

    def __init__(
        self,
        split: Path,
        where: str | None,
        columns: Sequence[str] | str,
        validation: float,
        differing: str = KEEP,
        fingerprint: str | None = None,
    ) -> None:
        self.split, self._opened_with = split, (split, where, columns, validation, differing)
        check_share(validation)
        self._validation, self._differing = float(validation), Differing(split, differing)
        self._trajectories = TrajectoryRows(split, where, columns, fingerprint)
        self._shard = lru_cache(OPEN_SEEDS if self._trajectories.of_seeds else OPEN_SHARDS)(open_shard)
        self.rules, self.simulates = self._trajectories.rules, self._trajectories.simulates

    @property
    def manifest(self) -> pa.Table:
        """Manifest rows of the trajectories, a table with one row per index (docs/columns.md)."""
        return self._trajectories.table

    @property
    def content_hashes(self) -> list[str]:
        """Content hashes of the trajectories' levels; of seeds, made from the levels at the first call."""
        return self._trajectories.hashes.to_pylist()

    @property
    def differing(self) -> Int[np.ndarray, " level"]:
        """Ids, ascending, of the levels read so far whose states differ on this machine from the stored ones."""
        return self._differing.level_ids

    @cached_property
    def size(self) -> Size:
        """Size of all levels."""
        return size_of(self.manifest["size"][0].as_py())

    def __len__(self) -> int:
        return len(self._trajectories)

    def __getitem__(self, index: int) -> Batch:
        """Read one trajectory, arrays [256, ...], with all fields and the observation `symbolic_flat`.

        Raises:
            IndexError: the trajectory does not exist.
            Failure: its data is damaged.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"There is no trajectory {index}: {self.split} has {len(self)}.")
        batch = self.read([index % len(self)], fields=["level", "record"])
        return jax.tree.map(lambda x: x[0], batch)

    def read(
        self,
        indices: ArrayLike,
        length: int | None = None,
        first: ArrayLike = 0,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> Batch:
        """Read trajectories, or a window of each; arrays [batch, time, ...].

        Args:
            indices: integer indices of trajectories [batch], in any order, with repetitions; a scalar counts as [1].
            length: steps per window, 1 to 256; None: whole records.
            first: step at which each window starts, 0 to 255, [batch] or a scalar; padding follows step 255.
            fields: names of further fields for `Batch.fields`, or prefixes of names, such as `record/state`.
            observation: an observation type of the environment, such as `symbolic_flat`; None: no observations.

        Raises:
            UserError: an index, field, observation type or window does not exist.
            Failure: the data is damaged.
        """
        windows, kind, chosen = Windows.of(length), parse_observation(observation), expand_fields(fields, self.size)
        indices = in_a_row(indices, "indices")
        starts = in_a_row(first, "first steps", len(indices))
        require_steps(starts)
        if self._repeats(windows, kind):
            records = Records(windows, chosen, self.rules.max_timesteps)
            return records.repeat(self.episodes(indices, [*chosen, GOAL], observation), starts)
        needed = [*chosen, *ALWAYS_FIELDS, *expand_fields(["level", *(["record/state"] if kind else [])], self.size)]
        whole = self._arrays(indices, needed)
        late = timed_out(whole["record/done"], whole["record/goal"], self.rules.max_timesteps)
        arrays = windows.cut(whole | {TRUNCATED: late}, starts)
        level, level_id = tree_of(Level, arrays, "level/"), self._trajectories.level_ids(indices)
        effective = action_mask(jax.tree.map(lambda x: np.moveaxis(x, 0, -1), level)).T[:, None]
        mask = windows.mask(starts) & self._differing.kept(level_id)[:, None]
        shown = observe(kind, level, tree_of(State, arrays, "record/state/")) if kind else None
        live = np.broadcast_to(effective, arrays["record/action"].shape)
        return batch_of(arrays, level_id, starts, mask, shown, live, chosen)

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
    ) -> Batches[Batch]:
        """Iterate over batches of trajectories, or of all their windows, which threads prefetch.

        Each trajectory or window occurs once per epoch. Padding, with `mask` False, fills the last batch, so that all
        batches have one shape and every host has equally many.

        Args:
            batch_size: trajectories or windows per batch on this host.
            seed: seed of the shuffling, which differs between epochs; None: sorted by level id and step.
            subset: `train` or `validation`, split by content hash; None: both.
            length: steps per window, 1 to 256; None: whole records.
            fields: as in `read`.
            observation: as in `read`.
            epochs: number of epochs; None: endless.
            process_index: index of this host.
            process_count: number of hosts that share the batches; all pass the same arguments but `process_index`.
            prefetch: number of batches to read ahead; None: two per core; from seeds, two loads per core, each of as
                many batches as hold 512 trajectories or windows (one batch with pixels).
            start: a result of `Batches.state`, from any host, to resume from; None: the first batch.

        Raises:
            UserError: an argument is invalid, or the subset is empty.
            Failure: from the iterator, if the data is damaged.
        """
        windows, indices, fields = Windows.of(length), self._subset(subset), expand_fields(fields, self.size)
        order = EpochOrder(len(indices) * windows.per_record, batch_size, seed, process_index, process_count)
        settings, kind = self._settings(subset=subset, length=as_int(length)), parse_observation(observation)

        def read(positions: range) -> list[Batch]:
            items, new = order.items(positions)
            which, first = windows.locate(items)
            batch = self.read(indices[which], length, first, fields, observation)
            return [replace(batch, mask=batch.mask & new[:, None])]

        def play(positions: range) -> list[Any]:
            items, new = order.items(positions)
            which, first = windows.locate(items)
            made = self.episodes(indices[which], [*fields, GOAL], observation)
            return records.parts(made, first, new, batch_size)

        if not self._repeats(windows, kind):
            return batches_of(read, order, settings, epochs, prefetch, start)
        records, together = Records(windows, fields, self.rules.max_timesteps), loaded_together(batch_size, kind)
        return batches_of(play, order, settings, epochs, prefetch, start, together, records.finish)

    def episodes(
        self,
        indices: ArrayLike,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> EpisodeBatch:
        """Read the first episodes of trajectories: env steps as rows, one episode after another.

        In a seed file, the rest of a record repeats its first episode; in other splits it may hold other successes in
        the same level. For seed files, only first episodes are simulated, side by side: the more at once, the faster.

        Args:
            indices: integer indices of trajectories [episode], in any order, with repetitions; a scalar counts as [1].
            fields: as in `read`.
            observation: as in `read`.

        Raises:
            UserError: an index, field or observation type does not exist.
            Failure: the data is damaged.
        """
        kind, chosen = parse_observation(observation), expand_fields(fields, self.size)
        gather = lambda rows: gather_episodes(self.split, rows, chosen, kind, self._shard, self._differing.note)
        read = self._trajectories.gathered(in_a_row(indices, "indices"), gather)
        return replace(read, mask=read.mask & self._differing.kept(read.level_id)[read.episode])

    def episode_batches(
        self,
        batch_size: int,
        seed: int | None = None,
        subset: str | None = None,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
        epochs: int | None = 1,
        process_index: int = 0,
        process_count: int = 1,
        prefetch: int | None = None,
        start: dict[str, Any] | None = None,
    ) -> Batches[EpisodeBatch]:
        """Iterate over batches of first episodes, which threads prefetch, many batches at once.

        Takes the arguments of `batches` except `length`, and raises what it raises. `mask` is False in padding.
        Without `prefetch`, two loads per core are read ahead, each of about a thousand episodes, or of one batch with
        pixels.
        """
        indices, fields, kind = self._subset(subset), expand_fields(fields, self.size), parse_observation(observation)
        order = EpochOrder(len(indices), batch_size, seed, process_index, process_count)

        def load(positions: range) -> list[EpisodeBatch]:
            items, new = order.items(positions)
            read = self.episodes(indices[items], fields, observation)
            return replace(read, mask=read.mask & new[read.episode]).parts(batch_size)

        together = 1 if kind == ObservationType.PIXELS else max(1, EPISODES_AT_ONCE // batch_size)
        settings = self._settings(subset=subset, episodes="first")
        return batches_of(load, order, settings, epochs, prefetch, start, together)

    def grain(
        self,
        subset: str | None = None,
        length: int | None = None,
        fields: Iterable[str] = (),
        observation: str | None = ObservationType.SYMBOLIC_FLAT,
    ) -> TrajectorySource:
        """Return single trajectories or windows, as a data source for grain or a dataset for a torch DataLoader.

        Its arguments are as in `batches`; order and batches are the loader's. Elements are dictionaries of numpy
        arrays [time, ...]: the attributes of `Batch`, and the fields. Observations of several arrays (`pixels`,
        `symbolic_entity`) are dictionaries, too.

        Raises:
            UserError: an argument is invalid, or the subset is empty.
        """
        chosen = expand_fields(fields, self.size)
        return TrajectorySource(self, self._subset(subset), subset, length, chosen, parse_observation(observation))

    torch = grain

    def levels(self, indices: ArrayLike) -> Level:
        """Read the levels of trajectories, for `levelproof.make`: numpy arrays, level axis last, in the given order.

        Args:
            indices: integer indices of trajectories [level]; a scalar counts as [1].

        Raises:
            UserError: an index does not exist.
            Failure: the data is damaged.
        """
        arrays = self._arrays(in_a_row(indices, "indices"), expand_fields(["level"], self.size))
        return jax.tree.map(lambda x: np.ascontiguousarray(np.moveaxis(x, 0, -1)), tree_of(Level, arrays, "level/"))

    def state(self, index: ArrayLike, step: ArrayLike = 0) -> EnvState:
        """Return the environment's state before a step of a trajectory, as jax arrays; its `level_index` is the index.

        Playing the stored actions from there by `rules` reproduces the stored steps, bit for bit.

        Args:
            index: integer index of a trajectory, or an array of indices, whose axes come first in the state.
            step: env step within the record, 0 to 255; broadcast against `index`.

        Raises:
            UserError: an index or a step does not exist.
            Failure: the data is damaged.
        """
        indices, steps = np.broadcast_arrays(whole_numbers(index, "indices"), whole_numbers(step, "steps"))
        require_steps(steps)
        fields = expand_fields(["level", "record/state", "record/timestep", "record/last_distance"], self.size)
        return state_in(self._arrays(indices.ravel(), fields), indices, steps)

    @property
    def fingerprint(self) -> str:
        """Hash of the level ids and of the steps to the goal: equal for equal selections of equal trajectories."""
        return self._trajectories.fingerprint

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments of `open`: unpickling rereads the manifest."""
        return _reopen, (self._opened_with, self.fingerprint)

    def __repr__(self) -> str:
        return f"levelproof.open({', '.join(map(repr, self._opened_with))}) of {many(len(self), 'trajectory')}"

    def _settings(self, **chosen: Any) -> dict[str, Any]:
        """Return what decides the batches of an iterator, besides their order."""
        return {"trajectories": self.fingerprint, "validation": self._validation, **chosen}

    def _repeats(self, windows: Windows, kind: ObservationType | None) -> bool:
        """Whether records are made of first episodes: those of seeds are, unless windows are observed as images.

        Images of whole episodes would take more memory than those of short windows.
        """
        return self._trajectories.of_seeds and (windows.whole or kind != ObservationType.PIXELS)

    def _subset(self, subset: str | None) -> Int[np.ndarray, " index"]:
        if subset is None:
            return np.arange(len(self))
        indices = np.flatnonzero(in_subset(self._trajectories.hashes, subset, self._validation))
        if not len(indices):
            raise UserError(
                f"None of the {len(self)} trajectories is in the subset {subset}: pass another validation= to open."
            )
        return indices

    def _arrays(self, indices: Int[np.ndarray, " batch"], fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Gather arrays of trajectories by field name, level axis first."""
        gather = lambda rows: gather_rows(self.split, rows, fields, self._shard, self._differing.note)
        return self._trajectories.gathered(indices, gather)


def _reopen(opened_with: tuple, fingerprint: str) -> Dataset:
    data = Dataset(*opened_with, fingerprint=fingerprint)
    if data.fingerprint != fingerprint:
        raise Failure(f"The split {data.split} no longer has the trajectories that it had: open it again.")
    return data
