"""Prioritised level replay (PLR; Jiang et al. 2021, arXiv:2010.03934 and 2110.02439): replays levels of high regret.

A buffer keeps the random levels with the highest scores. The score is MaxMC (second paper): the highest return of a
level since it entered the buffer, minus what the critic expects, averaged over the states of its latest episodes. What
it expects of a state is the reward so far plus the state's value, so that rewards for coming nearer cancel out. As in
the first paper, but not in the second (robust PLR), the policy also learns from new levels.
"""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.generalist.config import ReplayConfig
from levelproof.experts.generalist.curricula import Curriculum, EndedEpisodes, chance, fresh
from levelproof.levelgen.task.lanes import FIRST_EXTRA, Table

EMPTY = -1  # index of a slot's level


class ReplayBuffer(NamedTuple):
    """Levels that may be replayed."""

    level_index: Int[Array, " slot"]
    score: Float[Array, " slot"]  # mean over the level's episodes in its latest update; -inf: never attempted
    best: Float[Array, " slot"]  # highest return of an episode
    age: Int[Array, " slot"]  # updates since the last episode
    cumulative: Int[Array, " slot"]  # sums of replay weights; all 0 until the buffer is full enough


@cache
def replay(config: ReplayConfig) -> Curriculum:
    """Return the curriculum that replays a level of the buffer with probability `share`, and else draws a fresh one."""

    def draw(table: Table, buffer: ReplayBuffer, key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
        of_fresh, of_share, of_choice = jax.random.split(key, 3)
        old, ready = replayed(buffer, of_choice, lanes)
        return jnp.where(ready & chance(config.share, of_share, lanes), old, fresh(table, of_fresh, lanes))

    return Curriculum(partial(empty, config), draw, learn=partial(learned, config), facts=facts_of)


def empty(config: ReplayConfig) -> ReplayBuffer:
    whole = lambda value: jnp.full(config.capacity, value, jnp.int32)
    real = lambda value: jnp.full(config.capacity, value, jnp.float32)
    return ReplayBuffer(whole(EMPTY), real(-jnp.inf), real(-jnp.inf), whole(0), whole(0))


def replayed(buffer: ReplayBuffer, key: Key[Array, ""], lanes: int) -> tuple[Int[Array, " lane"], Bool[Array, ""]]:
    """Draw levels by replay probability; also return whether the buffer is full enough."""
    return buffer.level_index[drawn_from(buffer.cumulative, key, lanes)], buffer.cumulative[-1] > 0


def drawn_from(cumulative: Int[Array, " slot"], key: Key[Array, ""], lanes: int) -> Int[Array, " lane"]:
    """Draw slots by their weights, whose cumulative sums are given; any slot if all weights are 0."""
    number = jax.random.randint(key, (lanes,), 0, jnp.maximum(cumulative[-1], 1))
    return jnp.minimum(jnp.searchsorted(cumulative, number, side="right"), len(cumulative) - 1)


def waiting(buffer: ReplayBuffer) -> Bool[Array, " slot"]:
    """Mark the slots whose level has not been attempted."""
    return (buffer.level_index != EMPTY) & (buffer.score == -jnp.inf)


def learned(config: ReplayConfig, buffer: ReplayBuffer, ended: EndedEpisodes) -> ReplayBuffer:
    """Update the scores of levels whose episodes ended; new levels replace those with lower scores."""
    capacity = config.capacity
    order = jnp.argsort(buffer.level_index)
    place = jnp.searchsorted(buffer.level_index[order], ended.level_index)
    at = order[jnp.minimum(place, capacity - 1)]
    done = ended.done & jnp.isfinite(ended.gained - ended.expected)
    known = done & (buffer.level_index[at] == ended.level_index)
    slot = jnp.where(known, at, capacity)  # beyond the last: dropped
    best = buffer.best.at[slot].max(ended.gained, mode="drop")
    sums = lambda x: jnp.zeros(capacity).at[slot].add(x, mode="drop")
    episodes = sums(1.0)
    score = jnp.where(
        episodes > 0, sums(jnp.where(known, best[at] - ended.expected, 0)) / jnp.maximum(episodes, 1), buffer.score
    )
    age = jnp.where(episodes > 0, 0, buffer.age + 1)

    new = done & ~known & (ended.level_index < FIRST_EXTRA)
    levels, gained, regret = _by_level(ended, new)
    count = min(capacity, len(new))
    regret, which = jax.lax.top_k(regret, count)
    kept = jnp.where(waiting(buffer) & (episodes == 0), jnp.inf, score)
    lowest, weakest = jax.lax.top_k(-kept, count)
    enters = regret > -lowest
    slot = jnp.where(enters, weakest, capacity)
    put = lambda x, values: x.at[slot].set(values, mode="drop")
    after = ReplayBuffer(
        put(buffer.level_index, levels[which]),
        put(score, regret),
        put(best, gained[which]),
        put(age, 0),
        buffer.cumulative,
    )
    return with_weights(config, after)


def _by_level(ended: EndedEpisodes, some: Bool[Array, " episode"]) -> tuple[Array, Array, Array]:
    """Return the levels of some episodes, the highest return of each, and its score; the score of padding is -inf."""
    padded = jnp.where(some, ended.level_index, EMPTY)
    levels, place = jnp.unique(padded, return_inverse=True, size=len(some), fill_value=EMPTY)
    gained = jnp.full(len(some), -jnp.inf).at[place].max(jnp.where(some, ended.gained, -jnp.inf))
    sums = lambda x: jnp.zeros(len(some)).at[place].add(jnp.where(some, x, 0.0))
    episodes = sums(1.0)
    return levels, gained, jnp.where(episodes > 0, gained - sums(ended.expected) / jnp.maximum(episodes, 1), -jnp.inf)


def facts_of(buffer: ReplayBuffer) -> dict[str, float]:
    """Return metrics: the share of slots with an attempted level, the mean score of these, and whether replay began."""
    score = np.asarray(buffer.score)
    attempted = score > -np.inf
    return {
        "curriculum/filled": float(attempted.mean()),
        "curriculum/score": float(score[attempted].mean()) if attempted.any() else np.nan,
        "curriculum/replaying": int(buffer.cumulative[-1] > 0),
    }


def with_weights(config: ReplayConfig, buffer: ReplayBuffer) -> ReplayBuffer:
    """Recompute the replay weights, which are integers with an exact sum, from score ranks and ages."""
    attempted = buffer.score > -jnp.inf
    order = jnp.argsort(-buffer.score)
    rank = jnp.zeros(config.capacity).at[order].set(jnp.arange(1.0, config.capacity + 1))
    ages = jnp.where((buffer.age * attempted).any(), buffer.age, 1)
    parts = jnp.where(attempted, jnp.stack([rank ** (-1 / config.temperature), ages]), 0.0)
    parts /= jnp.maximum(parts.sum(1, keepdims=True), 1e-9)
    weight = (2.0**30 * ((1 - config.staleness) * parts[0] + config.staleness * parts[1])).astype(jnp.int32)
    enough = attempted.sum() >= config.enough
    return buffer._replace(cumulative=jnp.where(enough, jnp.cumsum(weight), 0))
