"""The curriculum that replays levels: prioritised level replay (Jiang et al. 2021, arXiv:2010.03934 and 2110.02439).

A buffer keeps random levels by the regret of their episodes. The score is MaxMC: by how much the highest return that an
episode of the level ever had exceeds the critic's values, on average over the last episode's states. So a level that
was solved once, and that the critic does not expect to solve, comes first. Unlike the papers, the policy learns from
levels that are new, too: half of all samples would otherwise be for nothing.
"""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.generalist.config import ReplayConfig
from levelproof.experts.generalist.curricula import Curriculum, EndedEpisodes, fresh
from levelproof.levelgen.task.lanes import FIRST_EXTRA, Table

EMPTY = -1  # index of a slot's level


class ReplayBuffer(NamedTuple):
    """Levels that may be replayed."""

    level_index: Int[Array, " slot"]
    score: Float[Array, " slot"]  # mean of the last update with episodes in it; -inf: never attempted
    best: Float[Array, " slot"]  # highest return of an episode
    age: Int[Array, " slot"]  # updates since the last episode
    cumulative: Float[Array, " slot"]  # sums of chances to be replayed, up to 1; 0: the buffer is not full enough


@cache
def replay(config: ReplayConfig) -> Curriculum:
    """Return the curriculum: with a chance of `share` a level of the buffer, else a fresh one."""

    def draw(table: Table, buffer: ReplayBuffer, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
        of_fresh, of_share, of_choice = jax.random.split(key, 3)
        old, ready = replayed(buffer, of_choice, lanes)
        return jnp.where(ready & chance(config.share, of_share, lanes), old, fresh(table, of_fresh, lanes))

    return Curriculum(partial(empty, config), draw, learn=partial(learned, config))


def empty(config: ReplayConfig) -> ReplayBuffer:
    whole = lambda value: jnp.full(config.capacity, value, jnp.int32)
    real = lambda value: jnp.full(config.capacity, value, jnp.float32)
    return ReplayBuffer(whole(EMPTY), real(-jnp.inf), real(-jnp.inf), whole(0), real(0))


def chance(share: float, key: Key[Array, ""], lanes: int) -> Bool[Array, " lane"]:
    return jax.random.uniform(key, (lanes,)) < share


def replayed(buffer: ReplayBuffer, key: Key[Array, ""], lanes: int) -> tuple[Int[Array, " lane"], Bool[Array, ""]]:
    """Draw levels of the buffer by their chances, and tell whether it is full enough."""
    slot = jnp.searchsorted(buffer.cumulative, jax.random.uniform(key, (lanes,)), side="right")
    return buffer.level_index[jnp.minimum(slot, len(buffer.cumulative) - 1)], buffer.cumulative[-1] > 0


def waiting(buffer: ReplayBuffer) -> Bool[Array, " slot"]:
    """Find levels that were put into the buffer before any attempt."""
    return (buffer.level_index != EMPTY) & (buffer.score == -jnp.inf)


def learned(config: ReplayConfig, buffer: ReplayBuffer, ended: EndedEpisodes) -> ReplayBuffer:
    """Score the levels whose episodes ended; fresh ones take the slots of levels with lower scores."""
    capacity = config.capacity
    order = jnp.argsort(buffer.level_index)
    place = jnp.searchsorted(buffer.level_index[order], ended.level_index)
    at = order[jnp.minimum(place, capacity - 1)]
    known = ended.done & (buffer.level_index[at] == ended.level_index)
    slot = jnp.where(known, at, capacity)  # beyond the last: dropped
    best = buffer.best.at[slot].max(ended.gained, mode="drop")
    sums = lambda x: jnp.zeros(capacity).at[slot].add(x, mode="drop")
    episodes = sums(1.0)
    score = jnp.where(episodes > 0, sums(best[at] - ended.value) / jnp.maximum(episodes, 1), buffer.score)
    age = jnp.where(episodes > 0, 0, buffer.age + 1)

    new = ended.done & ~known & (ended.level_index < FIRST_EXTRA)
    count = min(capacity, len(new))
    regret, which = jax.lax.top_k(jnp.where(new, ended.gained - ended.value, -jnp.inf), count)
    kept = jnp.where(waiting(buffer) & (episodes == 0), jnp.inf, score)
    lowest, weakest = jax.lax.top_k(-kept, count)
    enters = regret > -lowest
    slot = jnp.where(enters, weakest, capacity)
    put = lambda x, values: x.at[slot].set(values, mode="drop")
    after = ReplayBuffer(
        put(buffer.level_index, ended.level_index[which]),
        put(score, regret),
        put(best, ended.gained[which]),
        put(age, 0),
        buffer.cumulative,
    )
    return with_chances(config, after)


def with_chances(config: ReplayConfig, buffer: ReplayBuffer) -> ReplayBuffer:
    """Compute the chances to be replayed: by the rank of the score, and by age."""
    attempted = buffer.score > -jnp.inf
    order = jnp.argsort(-buffer.score)
    rank = jnp.zeros(config.capacity).at[order].set(jnp.arange(1.0, config.capacity + 1))
    parts = jnp.where(attempted, jnp.stack([rank ** (-1 / config.temperature), buffer.age]), 0.0)
    parts /= jnp.maximum(parts.sum(1, keepdims=True), 1e-9)
    sums = jnp.cumsum((1 - config.staleness) * parts[0] + config.staleness * parts[1])
    enough = attempted.sum() >= config.full_enough * config.capacity
    return buffer._replace(cumulative=jnp.where(enough, sums / sums[-1], 0.0))
