"""The levels that a policy is measured on: of a split, of level files, or sealed ones."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.levelgen.level import Level, name_of, size_of
from levelproof.levelgen.sampling.sampler import check_size, sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.level_files import levels_at, levels_below
from levelproof.pipeline.read.levels import COLUMNS, levels_of, rules_of
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.manifest import fragment_paths, require_manifest
from levelproof.pipeline.store.remote import is_remote

SEALED = range(2_000_000_000, 2_000_002_048)  # ids of the levels that policies are measured on, and never trained


class MeasuredLevels(NamedTuple):
    """Levels of one size."""

    name: str  # for people
    level_ids: Int[np.ndarray, " level"]
    levels: Level  # on the host, level axis last
    rules: TaskParams
    solved: Bool[np.ndarray, " level"] | None  # whether they are labelled solved; None: they have no labels


def sealed_levels(size: str, count: int | None) -> MeasuredLevels:
    """Sample the sealed levels of a size, or the first `count` of them.

    Raises:
        UserError: there is no such size.
    """
    try:
        check_size(size_of(size))
    except ValueError as error:
        raise UserError(f"Cannot sample sealed levels: {error}: set --size to s, m or l.") from None
    ids = np.array(SEALED[:count], np.int32)
    return MeasuredLevels(f"sealed {size}", ids, sample_levels(ids, size), DEFAULT_RULES, None)


def levels_in(
    place: Path, where: str | None, count: int | None, say: Callable[[str], None]
) -> Iterator[MeasuredLevels]:
    """Yield the levels of a split, or of the level files in a folder, by size; of each the first `count`.

    Calls `say` with a sentence for each level file that is left out.

    Raises:
        UserError: there is no split and no usable level file, or no level meets the condition.
        Failure: the split is damaged.
    """
    if is_remote(place) or (place.is_dir() and fragment_paths(place)):
        yield _of_split(place, where, count)
        return
    if where is not None:
        raise UserError(f"--where selects levels of a split, and {place} is none: leave it out.")
    try:
        listing = levels_below(place, JobConfig())
    except UserError:
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
    manifest = require_manifest(split, ["level_id", *COLUMNS, *columns_in(where)])
    rows = select(manifest.table, where)[:count]
    if not rows.num_rows:
        raise UserError(
            f"{split} has no level that meets the condition: `levelproof inspect {split}` shows its levels."
        )
    levels, labels = levels_of(manifest, rows), rows["label"].to_pylist()
    solved = np.array([label == Label.SOLVED for label in labels])
    name = f"{split}, {name_of(levels.size)}"
    return MeasuredLevels(name, rows["level_id"].to_numpy(), levels, rules_of(manifest), solved)
