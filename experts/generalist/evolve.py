"""ACCEL (Parker-Holder et al. 2022, arXiv:2203.01302): a curriculum that edits levels of the buffer of `replay`.

Every few updates, levels drawn by replay probability are copied and edited at random. Each child takes the slot of a
low-scoring level before its own first attempt; ACCEL evaluates children first. While children wait, half of the
episodes that do not replay play one of them, the other half a fresh random level. Once attempted, a child is scored
like any other level.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from levelproof.experts.generalist.config import EvolveConfig, ReplayConfig
from levelproof.experts.generalist.curricula import Curriculum, chance, fresh
from levelproof.experts.generalist.replay import (
    ReplayBuffer,
    drawn_from,
    empty,
    facts_of,
    learned,
    replayed,
    waiting,
    with_weights,
)
from levelproof.levelgen.level import Level
from levelproof.levelgen.mutate import children_of
from levelproof.levelgen.sampling.sampler import Sampler, sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.lanes import FIRST_EXTRA, ExtendedTable, Table
from levelproof.levelgen.task.rules import TaskParams


class Population(NamedTuple):
    """A buffer with the edited levels in it, which have no id."""

    buffer: ReplayBuffer
    levels: Level  # valid in slots whose level_index is FIRST_EXTRA or more
    generation: Int[Array, ""]


@cache
def evolve(config: EvolveConfig, buffer: ReplayConfig, sampler: Sampler, rules: TaskParams) -> Curriculum:
    """Return the curriculum over a sampler's levels and their edited copies."""
    return Curriculum(
        lambda: Population(empty(buffer), empty_level(sampler.size, buffer.capacity), jnp.int32(0)),
        partial(_draw, buffer.share),
        learn=lambda now, ended: now._replace(buffer=learned(buffer, now.buffer, ended)),
        table=lambda table, now: ExtendedTable(sampler, now.levels),
        breed=partial(_breed, config, buffer, sampler, rules),
        facts=_facts_of,
        every=config.every,
    )


def _draw(share: float, table: Table, now: Population, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
    of_fresh, of_share, of_old, of_half, of_child = jax.random.split(key, 5)
    old, ready = replayed(now.buffer, of_old, lanes)
    count = jnp.cumsum(waiting(now.buffer))
    child = now.buffer.level_index[drawn_from(count, of_child, lanes)]
    assert isinstance(table, ExtendedTable)
    new = jnp.where(chance(0.5, of_half, lanes) & (count[-1] > 0), child, fresh(table.sampler, of_fresh, lanes))
    return jnp.where(ready & chance(share, of_share, lanes), old, new)


def _breed(
    config: EvolveConfig,
    replaying: ReplayConfig,
    sampler: Sampler,
    rules: TaskParams,
    now: Population,
    rng: np.random.Generator,
) -> Population:
    """Add a generation of children to the buffer, from the host, unless too many of the last one still wait."""
    buffer: ReplayBuffer = jax.tree.map(np.asarray, now.buffer)
    capacity = replaying.capacity
    room = capacity - replaying.enough - waiting(buffer).sum()
    if not buffer.cumulative[-1] or config.children > room:
        return now
    weight = np.diff(buffer.cumulative, prepend=0)
    parents = rng.choice(capacity, config.children, p=weight / weight.sum())
    children, playable = children_of(_levels_of(now, parents, sampler), rng, config.edits, rules)
    born = np.flatnonzero(playable)
    free = np.argsort(np.where(waiting(buffer), np.inf, buffer.score), kind="stable")[: len(born)]
    # A unique index per child, so that a late episode cannot score the level that took over its slot
    names = int(now.generation) % (FIRST_EXTRA // capacity) * capacity + FIRST_EXTRA + free

    def put(x: Array, value: Any) -> Array:
        after = np.array(x)
        after[..., free] = value
        return jnp.asarray(after)

    values = {"level_index": names, "score": -np.inf, "best": -np.inf, "age": 0}
    buffer = buffer._replace(**{name: put(getattr(buffer, name), value) for name, value in values.items()})
    levels = jax.tree.map(lambda x, child: put(x, child[..., born]), now.levels, children)
    return Population(with_weights(replaying, buffer), levels, now.generation + 1)


def _facts_of(now: Population) -> dict[str, float]:
    """Return metrics of the buffer, the generations so far, and the share of attempted levels that are edited."""
    index, score = np.asarray(now.buffer.level_index), np.asarray(now.buffer.score)
    attempted = score > -np.inf
    edited = float((index[attempted] >= FIRST_EXTRA).mean()) if attempted.any() else np.nan
    return facts_of(now.buffer) | {"curriculum/edited": edited, "curriculum/generation": int(now.generation)}


def _levels_of(now: Population, slots: np.ndarray, sampler: Sampler) -> Level:
    """Return the levels in these slots."""
    index = np.asarray(now.buffer.level_index)[slots]
    extra = index >= FIRST_EXTRA
    sampled = sample_levels(np.where(extra, 0, index), sampler.size, sampler.distribution)
    return jax.tree.map(lambda x, y: np.where(extra, np.asarray(x)[..., slots], y), now.levels, sampled)
