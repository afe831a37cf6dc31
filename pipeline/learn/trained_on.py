"""The levels that a policy is trained on by reinforcement: random ones, those of a split, or of level files."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from levelproof.configs.compose import distributions
from levelproof.configs.errors import suggestion
from levelproof.configs.schema import JobConfig
from levelproof.configs.train import CURRICULA, TrainConfig
from levelproof.levelgen.batching import take
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.level import Level, concatenate_levels, name_of
from levelproof.levelgen.sampling.sampler import CHUNK, Sampler, sampler
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.measured import MeasuredLevels, is_split, levels_in, midway_levels
from levelproof.pipeline.learn.sealed import require_not_sealed, require_some_usable, without_sealed
from levelproof.pipeline.read.level_files import rule_settings
from levelproof.pipeline.store.progress_bar import shown_blocks
from levelproof.pipeline.store.seed.rows import MANY
from levelproof.pipeline.urls import is_remote


class TrainingLevels(NamedTuple):
    """Levels of one size."""

    name: str  # as shown to users
    levels: Level | Sampler
    rules: TaskParams
    facts: dict[str, Any]  # what identifies them, as JSON


def levels_for(config: TrainConfig, tell: Callable[[str], None]) -> TrainingLevels:
    """Return the levels that the settings name; leave out copies of sealed levels, with a notice.

    Raises:
        UserError: there are none, or of several sizes, or sealed ones.
        Failure: the split is damaged.
    """
    if config.levels in CURRICULA:
        return _random(config)
    place = Path(config.levels)
    if not is_remote(place) and not place.exists() and (hint := suggestion(config.levels, CURRICULA)):
        raise UserError(
            f"There are no levels at {place}{hint}: set levels to one of {', '.join(CURRICULA)}, or to a path."
        )
    split, groups = is_split(place), _groups(config, tell)
    if split:
        require_not_sealed(place, groups[0].level_ids, config.where)
    known = groups[0].content_hashes
    hashes = np.array(_hashed(groups[0].levels) if known is None else known, object)  # millions of str_ take gigabytes
    usable = without_sealed(place, hashes, tell)
    require_some_usable(place, usable)
    parts = [take(group.levels, np.flatnonzero(usable)) for group in groups]
    _require_enough(config, sum(map(len, parts)))
    levels = jax.device_put(concatenate_levels(parts))
    digest = hashlib.sha256("".join(hashes[usable]).encode()).hexdigest()[:16]
    facts = {"levels": str(place), "count": len(parts[0]), "content": digest}
    if len(groups) > 1:
        midway = b"".join(np.asarray(group.levels.state.position).tobytes() for group in groups[1:])
        facts["states"] = hashlib.sha256(midway).hexdigest()[:16]
    if other := rule_settings(groups[0].rules):
        facts["rules"] = other
    return TrainingLevels(str(place), levels, groups[0].rules, facts)


def _hashed(levels: Level) -> list[str]:
    """Hash the content of levels, which takes about a tenth of a millisecond for each; many show progress."""
    hashed = []
    for first in shown_blocks(len(levels), CHUNK, "levels hashed", least=MANY):
        hashed += content_hashes(take(levels, slice(first, first + CHUNK)))
    return hashed


def _require_enough(config: TrainConfig, starts: int) -> None:
    """Raise UserError if there are fewer start states than replay needs before it starts."""
    needed = config.replay.enough
    if config.choice == "replay" and starts < needed:
        raise UserError(
            f"choice=replay starts once {needed:,} levels have been attempted (replay.full_enough times "
            f"replay.capacity), but {config.levels} has only {starts:,}: set a smaller replay.capacity."
        )


def _groups(config: TrainConfig, tell: Callable[[str], None]) -> list[MeasuredLevels]:
    """Return the levels of a split or of files; of a split the levels' start first, then each state midway."""
    place, where = Path(config.levels), config.where or None
    if is_split(place) and config.starts > 1:
        data = Dataset(place, where, (), 0.0)
        return [midway_levels(data, None, share / config.starts) for share in range(config.starts)]
    if config.starts > 1:
        raise UserError(f"starts={config.starts} needs witnesses, but {place} is not a split: leave it out.")
    if not is_split(place) and config.where != TrainConfig.where:
        raise UserError(f"where={config.where} selects levels of a split, but {place} is not a split: leave it out.")
    groups = list(levels_in(place, where if is_split(place) else None, None, tell))
    if len(groups) > 1:
        sizes = ", ".join(name_of(group.levels.size) for group in groups)
        raise UserError(
            f"{place} has levels of the sizes {sizes}: train on files of one size, in a folder of their own."
        )
    return groups


def _random(config: TrainConfig) -> TrainingLevels:
    distribution = distributions()[config.distribution]
    try:
        JobConfig(size=config.size, distribution=distribution)  # raises if no job can have such levels
        levels = sampler(config.size, distribution)
    except ValueError as error:
        raise UserError(f"Cannot sample levels: {str(error).rstrip('.')}.") from None
    name = f"random {config.size}"
    return TrainingLevels(
        f"random levels of size {config.size}",
        levels,
        DEFAULT_RULES,
        {"levels": name, "distribution": config.distribution},
    )
