"""The curriculum that edits levels: ACCEL (Parker-Holder et al. 2022, arXiv:2203.01302), on the buffer of `replay`.

Every few updates some levels of the buffer, drawn by their chances, get children: copies after random edits. A child
takes the slot of a level with a low score and waits there for its first attempt. Of episodes that replay nothing, half
are in such children, half in fresh random levels; from then on a child is scored like any other level.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from levelproof.experts.generalist.config import EvolveConfig, ReplayConfig
from levelproof.experts.generalist.curricula import Curriculum, fresh
from levelproof.experts.generalist.replay import (
    ReplayBuffer,
    chance,
    empty,
    learned,
    replayed,
    waiting,
    with_chances,
)
from levelproof.levelgen.level import Level
from levelproof.levelgen.mutate import children_of
from levelproof.levelgen.sampling.sampler import Sampler, sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.lanes import FIRST_EXTRA, ExtendedTable, Table
from levelproof.levelgen.task.rules import TaskParams


class Population(NamedTuple):
    """A buffer, and the levels in it that no id gives."""

    buffer: ReplayBuffer
    levels: Level  # of slots whose index is FIRST_EXTRA or more; of others anything
    generation: Int[Array, ""]


@cache
def evolve(config: EvolveConfig, buffer: ReplayConfig, sampler: Sampler, rules: TaskParams) -> Curriculum:
    """Return the curriculum over levels of a sampler, played by these rules."""
    return Curriculum(
        lambda: Population(empty(buffer), empty_level(sampler.size, buffer.capacity), jnp.int32(0)),
        partial(_draw, buffer.share),
        learn=lambda now, ended: now._replace(buffer=learned(buffer, now.buffer, ended)),
        table=lambda table, now: ExtendedTable(sampler, now.levels),
        breed=partial(_breed, config, buffer, sampler, rules),
        every=config.every,
    )


def _draw(share: float, table: Table, now: Population, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
    of_fresh, of_share, of_old, of_half, of_child = jax.random.split(key, 5)
    old, ready = replayed(now.buffer, of_old, lanes)
    count = jnp.cumsum(waiting(now.buffer))
    number = jax.random.randint(of_child, (lanes,), 0, jnp.maximum(count[-1], 1))
    child = now.buffer.level_index[jnp.minimum(jnp.searchsorted(count, number, side="right"), len(count) - 1)]
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
    """Put a generation of children into the buffer; numpy on the host."""
    buffer: ReplayBuffer = jax.tree.map(np.asarray, now.buffer)
    capacity = replaying.capacity
    if not buffer.cumulative[-1]:
        return now
    chances = np.diff(buffer.cumulative.astype(float), prepend=0.0)
    parents = rng.choice(capacity, config.children, p=chances / chances.sum())
    children, playable = children_of(_levels_of(now, parents, sampler), rng, config.edits, rules)
    born = np.flatnonzero(playable)
    free = np.argsort(np.where(waiting(buffer), np.inf, buffer.score), kind="stable")[: len(born)]
    # An index of its own for each: an episode that ends late must not score the level that took the slot
    names = int(now.generation) % (FIRST_EXTRA // capacity) * capacity + FIRST_EXTRA + free

    def put(x: Array, value: Any) -> Array:
        after = np.array(x)
        after[..., free] = value
        return jnp.asarray(after)

    values = names, -np.inf, -np.inf, 0, buffer.cumulative[free]
    buffer = ReplayBuffer(*(put(x, value) for x, value in zip(buffer, values, strict=True)))
    levels = jax.tree.map(lambda x, child: put(x, child[..., born]), now.levels, children)
    return Population(with_chances(replaying, buffer), levels, now.generation + 1)


def _levels_of(now: Population, slots: np.ndarray, sampler: Sampler) -> Level:
    """Return the levels in these slots."""
    index = np.asarray(now.buffer.level_index)[slots]
    extra = index >= FIRST_EXTRA
    sampled = sample_levels(np.where(extra, 0, index), sampler.size, sampler.distribution)
    return jax.tree.map(lambda x, y: np.where(extra, np.asarray(x)[..., slots], y), now.levels, sampled)
