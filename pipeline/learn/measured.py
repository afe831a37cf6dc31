"""The levels that a policy is measured on: of a split, of level files, or sealed ones."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import jax
import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int

from levelproof.configs.schema import JobConfig, other_sampler
from levelproof.experts.labels import Label
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level, concatenate_levels, name_of, size_of
from levelproof.levelgen.sampling.sampler import check_size, on_cpu, sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.sealed import SEALED_IDS, known_sealed
from levelproof.pipeline.read.level_files import levels_at, levels_below
from levelproof.pipeline.read.levels import COLUMNS, levels_of, rules_of
from levelproof.pipeline.read.select import labelled, require_selected
from levelproof.pipeline.store.job_note import sound_note
from levelproof.pipeline.store.manifest import fragment_paths, refuse_folder_of_splits, require_manifest
from levelproof.pipeline.store.progress_bar import shown_blocks
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.urls import as_typed, is_remote, quoted

AT_ONCE = 256  # witnesses per read
LEVELS_AT_ONCE = 2**14  # levels per read, with their records up to 100 MB; each read opens its shards


class MeasuredLevels(NamedTuple):
    """Levels of one size on which policies are measured."""

    name: str  # as shown to users
    level_ids: Int[np.ndarray, " level"]
    levels: Level  # on the host, level axis last
    rules: TaskParams
    solved: Bool[np.ndarray, " level"] | None  # whether they are labelled solved; None: they have no labels
    start: float = 0.0  # step of a witness from whose state attempts start, as a share of its steps to the goal
    published: Mapping[str, float] = MappingProxyType({})  # published solve rates on these levels, by agent
    content_hashes: Sequence[str] | None = None  # None: not known

    def first(self, count: int | None) -> "MeasuredLevels":
        """Return the first `count` levels; None: all."""
        if count is None:
            return self
        some = np.arange(len(self.level_ids))[:count]
        solved = None if self.solved is None else self.solved[some]
        hashes = None if self.content_hashes is None else self.content_hashes[:count]
        levels = take(self.levels, some)
        return self._replace(level_ids=self.level_ids[some], levels=levels, solved=solved, content_hashes=hashes)


def sealed_levels(size: str, count: int | None) -> MeasuredLevels:
    """Sample the sealed levels of a size, or the first `count` of them.

    Raises:
        UserError: there is no such size.
    """
    try:
        check_size(size_of(size))
    except ValueError as error:
        raise UserError(f"Cannot sample sealed levels: {error}: set --size to s, m or l.") from None
    ids = np.array(SEALED_IDS[:count], np.int32)
    known = known_sealed(size)
    solved = known and known.solved[:count]
    with on_cpu():  # where they were labelled
        levels = sample_levels(ids, size)
    return MeasuredLevels(f"sealed {size}", ids, levels, DEFAULT_RULES, solved)


def is_split(place: Path) -> bool:
    """Whether a path or URL is that of a split."""
    return is_remote(place) or is_seed(place) or (place.is_dir() and bool(fragment_paths(place)))


def levels_in(
    place: Path, where: str | None, count: int | None, say: Callable[[str], None]
) -> Iterator[MeasuredLevels]:
    """Yield the levels of a split, or of the level files in a folder, by size; of each the first `count`.

    Calls `say` with a sentence for each level file that is left out.

    Raises:
        UserError: there is no split with levels and no usable level file, or no level meets the condition.
        Failure: the split is damaged.
    """
    if is_split(place):
        yield _of_split(place, where, count)
        return
    if where is not None:
        raise UserError(f"--where selects levels of a split, but {place} is not a split: leave --where out.")
    if sound_note(place):
        require_manifest(place, [])  # raises: a job has begun here, and nothing is committed
    try:
        listing = levels_below(place, JobConfig(level_files=str(place)))
    except UserError:
        refuse_folder_of_splits(place)
        raise UserError(f"There are no levels at {place}: name a split, a level file or a folder of them.") from None
    if not listing.levels:
        raise UserError(listing.refused[0])
    for sentence in (*listing.copies, *listing.refused):
        say(sentence)
    for size, origins in listing.levels.items():
        ids = np.array([*origins][:count])
        levels = levels_at([origins[level_id] for level_id in ids.tolist()])
        yield MeasuredLevels(f"{place}, {size}", ids, levels, DEFAULT_RULES, None)


def _of_split(split: Path, where: str | None, count: int | None) -> MeasuredLevels:
    manifest = require_selected(split, COLUMNS, where, count)
    rows = manifest.table
    if not rows.num_rows:
        raise UserError(
            f"{split} has no level that meets the condition: `levelproof inspect {quoted(split)}` shows its levels."
        )
    blocks = shown_blocks(rows.num_rows, LEVELS_AT_ONCE, "levels read", least=LEVELS_AT_ONCE + 1)
    read = lambda first: levels_of(manifest, rows.slice(first, LEVELS_AT_ONCE))
    levels = concatenate_levels([jax.tree.map(np.array, read(first)) for first in blocks])  # copied: views keep records
    name, ids = f"{as_typed(split)}, {name_of(levels.size)}", rows["level_id"].to_numpy()
    # Rows have the hashes of what their own sampler made
    hashes = None if other_sampler(manifest.config or {}) else rows["content_hash"].to_pylist()
    solved = labelled(rows, [Label.SOLVED])
    return MeasuredLevels(name, ids, levels, rules_of(manifest), solved, content_hashes=hashes)


def midway_levels(data: Dataset, count: int | None, start: float) -> MeasuredLevels:
    """Return levels of a dataset that have a witness, each in the state at a share `start` of its way to the goal.

    Raises:
        UserError: no level has a witness.
        Failure: the split is damaged.
    """
    steps = data.manifest["steps_to_goal"]
    witnessed = np.flatnonzero(steps.is_valid().to_numpy())[:count]
    if not len(witnessed):
        raise UserError(f"No level of {data.split} that meets the condition has a witness: choose others.")
    at = (steps.take(pa.array(witnessed)).to_numpy() * start).astype(np.int64)
    parts = [data.state(witnessed[i : i + AT_ONCE], at[i : i + AT_ONCE]).level for i in range(0, len(at), AT_ONCE)]
    levels = jax.tree.map(lambda *xs: np.moveaxis(np.concatenate(xs), 0, -1), *parts)
    name = f"{as_typed(data.split)}, {name_of(data.size)}, {start:.0%} into witnesses"
    solved = labelled(data.manifest, [Label.SOLVED])[witnessed]
    ids = data.manifest["level_id"].to_numpy()[witnessed]
    return MeasuredLevels(name, ids, levels, data.rules, solved, start)
